"""Checks of a whole environment."""

import functools
from collections.abc import Callable
from typing import Any

from rp_jax.envs.check.bodies import (
    body_disagreements,
    hasty_controls,
    odd_controls,
    restless_plans,
)
from rp_jax.envs.check.dangers import wrong_dangers
from rp_jax.envs.check.episodes import odd_values, wrong_ends
from rp_jax.envs.check.features import wrong_features, wrong_samples
from rp_jax.envs.check.hazard_moves import moved_statics, unlike_moves
from rp_jax.envs.check.problems import EnvError, attempted, own_settings, trouble
from rp_jax.envs.check.purity import impurities
from rp_jax.envs.check.structure import contract_problems
from rp_jax.envs.check.symmetry import asymmetries
from rp_jax.envs.check.trial import Trial
from rp_jax.envs.check.windows import small_windows
from rp_jax.validate import number

CHECKS: dict[str, Callable[[Trial], list[str]]] = {
    "finite values": odd_values,
    "ends of episodes": wrong_ends,
    "moves of the body": body_disagreements,
    "the baseline policy": odd_controls,
    "plans": restless_plans,
    "delayed controls": hasty_controls,
    "static hazards": moved_statics,
    "moves of hazards": unlike_moves,
    "features": wrong_features,
    "samples": wrong_samples,
    "mirror images": asymmetries,
    "reach": small_windows,
    "dangers": wrong_dangers,
    "purity": impurities,  # last: it runs functions without compilation
}


def check_contract(env: Any, params: Any) -> None:
    """Checks the structure of an environment: functions, fields, shapes and types.

    Nothing is simulated; functions are only traced.

    Args:
        env: the environment, a module or any object with the functions of
            `rp_jax.envs.contract.Env`.
        params: its parameters.

    Raises:
        EnvError: something is wrong; `problems` has a sentence for each finding.
    """
    with own_settings():
        found = contract_problems(env, params)
    if found:
        raise EnvError(found)


def check_env(env: Any, params: Any, *, seed: int = 0) -> None:
    """Checks that an environment fulfils its contract, before any threat is learned.

    First its structure is checked, as by `check_contract`. Then some 20,000 steps are made, and
    the environment, the body's model and the hazard sources are compared with one another: whether
    they move bodies and hazards alike, whether danger comes from hazards that are listed, whether
    features can be inverted, whether what can be hit is in reach, and so on. Most environments take
    less than half a minute, nearly all of it for compilation.

    What never happens in those steps is not seen: an environment that passes may still be wrong.

    Args:
        env: the environment, a module or any object with the functions of
            `rp_jax.envs.contract.Env`; what `rp_jax.envs.optional` names may be left out.
        params: its parameters.
        seed: of all random numbers.

    Raises:
        EnvError: something is wrong; `problems` has a sentence for each finding.
        ValueError: the seed is not an integer from 0 on.
    """
    number("seed", seed, least=0, integer=True)
    check_contract(env, params)
    with own_settings():
        found = simulated_problems(env, params, seed)
    if found:
        raise EnvError(found)


def simulated_problems(env: Any, params: Any, seed: int) -> list[str]:
    """Returns what is wrong with an environment whose structure is sound, one sentence each.

    Args:
        env: the environment.
        params: its parameters.
        seed: of all random numbers.
    """
    trial = Trial(env, params, seed)
    try:
        _ = trial.steps
    except Exception as error:
        return [f"a batch of episodes cannot be run by auto_reset_step: {trouble(error)}"]
    found: list[str] = []
    for what, check in CHECKS.items():
        found += attempted(f"the check of {what}", functools.partial(check, trial))
    return found
