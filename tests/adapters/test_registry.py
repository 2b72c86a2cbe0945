import pytest

from rp_jax.adapters import registry
from rp_jax.envs import jam


def test_an_environment_is_made_from_its_name_and_settings():
    env, params = registry.make("jam", num_obstacles=3, time_limit=7)
    assert env is jam
    assert params.num_obstacles == 3
    assert params.time_limit == 7


def test_unknown_names_and_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"^name is 'jem'; it must be one of 'circuit', 'jam'"):
        registry.make("jem")
    with pytest.raises(ValueError, match=r"^num_obstacles is 0"):
        registry.make("jam", num_obstacles=0)
