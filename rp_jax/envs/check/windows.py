"""Whether hazards that are not in reach can be hit within the horizon all the same."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import join, repeat, take
from rp_jax.envs.check.comparison import beyond, tolerance_of
from rp_jax.envs.check.pairs import Pairs
from rp_jax.envs.check.problems import number_of
from rp_jax.envs.check.trial import Trial

STARTS = 1024  # that are sampled and moved outward, and that are visited
FACTORS = (1.0, 1.02, 1.05, 1.1, 1.2, 1.35, 1.6, 2.0, 2.6, 3.5)  # by which they are moved
TRIES = 2  # rollouts of each start


def small_windows(trial: Trial) -> list[str]:
    """Returns which kinds of hazards are hit within the horizon from where they are not in reach.

    Args:
        trial: the environment.
    """
    found = []
    for kind, pairs in trial.pairs.items():
        starts = join(_outward(pairs), _strangers(trial, pairs))
        count = len(jax.tree.leaves(starts)[0])
        if not count:
            continue
        hits = {
            policy: int(_rolled(trial, pairs, starts, policy).sum())
            for policy in ("any action and then the baseline policy", "random actions")
        }
        if any(hits.values()):
            parts = [
                f"{number_of(hit, TRIES * count, 'rollouts')} under {policy}"
                for policy, hit in hits.items()
            ]
            found.append(
                f"in_reach of the source of {kind!r} is too narrow: within {pairs.horizon} steps "
                f"from pairs just out of reach, the hazard is hit in {' and in '.join(parts)}; "
                "where in_reach is False, no hit may be possible within the horizon"
            )
    return found


def _outward(pairs: Pairs) -> tuple[Any, Any]:
    """Sampled pairs whose relative position is stretched until they are just out of reach."""
    body, hazard = pairs.sample(STARTS)
    position = getattr(body, "position", None)
    axes = 2 if position is None else position[0].size
    features = pairs.features(body, hazard)
    tolerance = tolerance_of(features, body, hazard)
    chosen, stretched = np.zeros(STARTS, bool), features.copy()
    for factor in FACTORS:
        moved = features.copy()
        moved[:, :axes] *= factor
        seen, _, reach = pairs.look(*pairs.restore(moved))
        new = ~reach & ~beyond(seen, moved, tolerance * factor) & ~chosen
        stretched[new] = moved[new]
        chosen |= new
    return take(pairs.restore(stretched), chosen)


def _strangers(trial: Trial, pairs: Pairs) -> tuple[Any, Any]:
    """Visited hazards out of reach of the body, as it was and as it was in other visited states."""
    bodies, hazards = trial.visited(pairs.kind, STARTS)
    count = len(jax.tree.leaves(bodies)[0])
    if not count:
        return bodies, hazards
    whose = trial.draws.integers(count, len(trial.steps.action))
    others = take(trial.steps.before.body, whose)
    bodies, hazards = join(bodies, others), join(hazards, hazards)
    return take((bodies, hazards), ~pairs.look(bodies, hazards)[2])


def _rolled(trial: Trial, pairs: Pairs, starts: tuple[Any, Any], policy: str) -> np.ndarray:
    """Whether each of some rollouts (TRIES * n,) of the sub-R-MDP hits within the horizon."""
    draws = trial.draws
    body, hazard = repeat(starts, TRIES)
    count = len(jax.tree.leaves(body)[0])
    choice, actions = draws.uniform(count), draws.integers(count, trial.num_actions)
    holds = np.arange(count) % 2 == 0  # every second row holds its action
    hit = np.zeros(count, bool)
    for k in range(pairs.horizon):
        moved = pairs.drift(draws.keys(count), hazard, body)
        if policy == "random actions":
            body = trial.away(body, actions)
            actions = np.where(holds, actions, draws.integers(count, trial.num_actions))
        else:
            body = trial.away(body, actions, k - 1, choice)
        hazard = moved
        hit |= pairs.look(body, hazard)[1]
    return hit
