"""Whether the environment moves the body as the body's model does."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import Batched, flat, join, take, typed
from rp_jax.envs.check.comparison import RARE, unequal
from rp_jax.envs.check.problems import number_of, same_structure, value_of
from rp_jax.envs.check.trial import Trial


def body_disagreements(trial: Trial) -> list[str]:
    """Returns where `step` and the body's model take a body to different states.

    Args:
        trial: the environment.
    """
    steps = join(trial.steps, trial.placed)
    return _unlike(trial, steps, steps.modelled, "params.body") + _of_other_models(trial, steps)


def _unlike(trial: Trial, steps: Any, modelled: Any, model: str) -> list[str]:
    bad = unequal(steps.reached.body, modelled, before=steps.before.body)
    made = np.bincount(steps.action, minlength=trial.num_actions)
    wrong = np.bincount(steps.action[bad], minlength=trial.num_actions)
    always = (made > 1) & (wrong == made)
    if not always.any() and bad.sum() <= RARE * len(bad):
        return []
    worst, row = int(np.argmax(wrong / np.maximum(made, 1))), int(np.argmax(bad))
    reached, other = value_of(take(steps.reached.body, row)), value_of(take(modelled, row))
    return [
        f"step: reached.body differs from {model}.step(state.body, {model}.control(action)) in "
        f"{number_of(int(bad.sum()), len(bad), 'steps')} ({wrong[worst]:,} of {made[worst]:,} with "
        f"action {worst}); it is {reached} and the model gives {other}; threats are learned from "
        "the model, so both must be the same for all actions"
    ]


def _of_other_models(trial: Trial, steps: Any) -> list[str]:
    """What holds of the models of sub-R-MDPs, where they are not that of the parameters."""
    found = []
    for kind in trial.pairs:
        model = trial.env.sub_rmdps(trial.params)[kind].body
        if model is trial.model or _alike(model, trial.model):
            continue

        def step(params: Any, body: Any, action: Any, kind: str = kind) -> Any:
            model = trial.env.sub_rmdps(params)[kind].body
            return model.step(body, model.control(action))

        moved = Batched(step)(trial.params, steps.before.body, steps.action)
        found += _unlike(trial, steps, moved, f"sub_rmdps(params)[{kind!r}].body")
    return found


def _alike(one: Any, other: Any) -> bool:
    if not same_structure(one, other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def odd_controls(trial: Trial) -> list[str]:
    """Returns where controls, or the bodies that they lead to, are not finite.

    Args:
        trial: the environment.
    """
    bodies = [
        take(trial.steps.before.body, trial.draws.among(np.arange(len(trial.steps.action)), 512))
    ]
    bodies += [pairs.sample(256)[0] for pairs in trial.pairs.values()]
    body = join(*bodies)
    count = len(jax.tree.leaves(body)[0])
    found = []
    if not trial.plans:

        def act(params: Any, body: Any, key: Any) -> Any:
            policy = params.body.baseline
            return policy.act(body, policy.draw(typed(key)))

        controls = Batched(act)(trial.params, body, trial.draws.keys(count))
        bad = ~np.isfinite(flat(controls)).all(axis=1)
        if bad.any():
            where = number_of(int(bad.sum()), count, "states of the body")
            value = value_of(take(controls, int(np.argmax(bad))))
            found.append(
                f"params.body.baseline.act gives the control {value} in {where}; it must be finite"
            )
    moved = trial.away(body, trial.draws.integers(count, trial.num_actions))
    bad = ~np.isfinite(flat(moved)).all(axis=1)
    if bad.any():
        where = number_of(int(bad.sum()), count, "states of the body")
        value = value_of(take(moved, int(np.argmax(bad))))
        found.append(f"params.body.step leads to {value} in {where}; it must be finite")
    return found
