"""Public check of an environment: finds what is wrong before a threat is learned."""

from rp_jax.envs.check.inspection import check_contract, check_env
from rp_jax.envs.check.problems import EnvError

__all__ = ["EnvError", "check_contract", "check_env"]
