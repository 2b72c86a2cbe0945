"""Whether the environment moves the body as the body's model does."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rp_jax.dynamics import ControlDistribution, delayed
from rp_jax.envs.check.batches import Batched, flat, join, take, typed
from rp_jax.envs.check.comparison import RARE, unequal
from rp_jax.envs.check.problems import number_of, same_structure, value_of
from rp_jax.envs.check.trial import Trial

HASTY = 8192  # pairs that are stepped under two actions
PLANNED = 512  # rollouts of plans


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
        moved = _of_sub_rmdp(trial, kind)(steps.before.body, steps.action)
        found += _unlike(trial, steps, moved, f"sub_rmdps(params)[{kind!r}].body")
    return found


def _of_sub_rmdp(trial: Trial, kind: str) -> Callable[[Any, np.ndarray], Any]:
    """Returns the step of the body of a kind's sub-R-MDP, for bodies and actions (n, ...)."""

    def step(params: Any, body: Any, action: Any) -> Any:
        model = trial.env.sub_rmdps(params)[kind].body
        return model.step(body, model.control(action))

    batched = Batched(step)
    return lambda bodies, actions: batched(trial.params, bodies, actions)


def _alike(one: Any, other: Any) -> bool:
    if not same_structure(one, other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def hasty_controls(trial: Trial) -> list[str]:
    """Returns for which kinds a control decides at once what is hit, though it is delayed.

    It matters where threats are enumerated, which leaves the last control out.

    Args:
        trial: the environment.
    """
    found = []
    for kind, pairs in trial.pairs.items():
        model = trial.env.sub_rmdps(trial.params)[kind].body
        listed = isinstance(model.baseline, ControlDistribution)
        if not (pairs.static and listed and delayed(model)):
            continue
        body, hazard = pairs.sample(HASTY)
        step = _of_sub_rmdp(trial, kind)
        one, other = (
            pairs.look(step(body, trial.draws.integers(HASTY, trial.num_actions)), hazard)[1]
            for _ in range(2)
        )
        unlike = int((one != other).sum())
        if unlike > RARE * HASTY:
            found.append(
                f"sub_rmdps(params)[{kind!r}].body.delayed is True, but a control decides at once "
                "whether a hazard is hit: after one step under two actions, `hits` differs in "
                f"{number_of(unlike, HASTY, 'pairs')}; `delayed` must be False, as the last "
                "control is left out of the enumerated threats of a body that is delayed"
            )
    return found


def restless_plans(trial: Trial) -> list[str]:
    """Returns which plans do not end at rest, or take controls that no action has.

    Args:
        trial: the environment.
    """
    if not trial.plans:
        return []
    plans, draws = trial.model.baseline, trial.draws
    rows = draws.among(np.arange(len(trial.steps.action)), PLANNED)
    body, choice = take(trial.steps.before.body, rows), draws.uniform(PLANNED)
    plan = (choice.astype(np.float32) * len(plans.target)).astype(int)
    actions, odd = draws.integers(PLANNED, trial.num_actions), np.zeros(PLANNED, bool)
    table = flat(jax.device_get(trial.model.actions))
    body = trial.away(body, actions)
    for k in range(plans.horizon - 1):
        control = flat(trial.control(body, k, choice))
        gaps = np.abs(control[:, None] - table).max(axis=-1).min(axis=-1)
        odd |= gaps > 1e-5 * (1 + np.abs(table).max())
        body = trial.away(body, actions, k, choice)
    found = []
    moved = trial.away(body, actions, plans.horizon - 1, choice)
    gone = np.abs(moved.position - body.position).max(axis=-1)
    restless = gone > 1e-5 * (1 + np.abs(body.position).max())
    if restless.any():
        i = int(np.argmax(restless))
        found.append(
            f"params.body.baseline: plan {plan[i]} still moves after its horizon of "
            f"{plans.horizon} steps, by {gone[i]:.6g} in a step (in "
            f"{number_of(int(restless.sum()), PLANNED, 'rollouts')}); each must be at rest then"
        )
    if odd.any():
        i = int(np.argmax(odd))
        found.append(
            f"params.body.baseline: plan {plan[i]} takes a control that is none of "
            f"params.body.actions (in {number_of(int(odd.sum()), PLANNED, 'rollouts')}); the agent "
            "must be able to follow each plan"
        )
    return found


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
