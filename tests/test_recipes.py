import probe
import pytest

from rp_jax import recipes
from rp_jax.envs import circuit, jam, point_gather

CONFIGS = {name: getattr(recipes, name) for name in dir(recipes) if name[:5] in ("TUNED", "PAPER")}


@pytest.mark.parametrize("name", CONFIGS)
def test_every_recipe_is_in_range(name):
    CONFIGS[name].validate(name.lower())


def test_there_are_recipes_of_threats_and_a_planner():
    assert len(CONFIGS) == 8


def test_threats_that_are_enumerated_have_one_recipe_and_those_that_are_sampled_another():
    kinds = {
        **{f"jam {kind}": sub for kind, sub in jam.sub_rmdps(jam.make_params(1)).items()},
        **circuit.sub_rmdps(circuit.make_params("circle")),
        **point_gather.sub_rmdps(point_gather.make_params()),
        **probe.sub_rmdps(probe.make_params()),
    }
    assert {kind: recipes.tuned(sub) for kind, sub in kinds.items()} == {
        "jam wall": recipes.TUNED_WALL,
        "jam obstacle": recipes.TUNED_OBSTACLE,
        "wall": recipes.TUNED_WALL,
        "bomb": recipes.TUNED_OBSTACLE,  # it stays, but its rollouts are too many to enumerate
        "pit": recipes.TUNED_WALL,
    }


def test_a_hazard_that_does_not_say_that_it_stays_may_move():
    (sub,) = probe.sub_rmdps(probe.make_params()).values()
    assert recipes.tuned(sub.replace(source=object())) is recipes.TUNED_OBSTACLE
