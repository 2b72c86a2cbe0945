"""The environments that the adapters offer, by name."""

from typing import Any

from rp_jax.envs import circuit, jam, point_gather
from rp_jax.envs.contract import Env
from rp_jax.validate import one_of

ENVS: dict[str, Any] = {"circuit": circuit, "jam": jam, "point_gather": point_gather}


def make(name: str, **settings: Any) -> tuple[Env, Any]:
    """Returns an environment and its parameters.

    Args:
        name: a name in `ENVS`.
        **settings: settings of the environment's `make_params`.

    Raises:
        ValueError: there is no such environment, or a setting is out of range.
    """
    env = ENVS[one_of("name", name, ENVS)]
    return env, env.make_params(**settings)
