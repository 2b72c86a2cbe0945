"""Values that are computed in episodes, and how episodes begin and end."""

import jax
import numpy as np

from rp_jax.envs.check.batches import join, take
from rp_jax.envs.check.problems import number_of, value_of
from rp_jax.envs.check.trial import Steps, Trial


def odd_values(trial: Trial) -> list[str]:
    """Returns which observations, rewards, dangers and features are not finite.

    Args:
        trial: the environment.
    """
    steps, found = trial.steps, []
    count = len(steps.action)
    bad = np.asarray(steps.infinite) >= 0
    if bad.any():
        index = int(steps.infinite[bad][0])
        found.append(
            f"observe: value {index} of the observation is not finite in "
            f"{number_of(int(bad.sum()), count, 'states')}; all must be finite"
        )
    outside = np.asarray(steps.scan) >= 0
    if outside.any():
        index = int(steps.scan[outside][0])
        found.append(
            f"observe: value {index} of the LIDAR is outside [0, 1] in "
            f"{number_of(int(outside.sum()), count, 'states')}; the first LIDAR_BINS values must "
            "be distances as shares of the LIDAR's range"
        )
    for field in ("reward", "danger"):
        values = getattr(steps.outcome, field)
        bad = ~np.isfinite(values)
        if bad.any():
            where = number_of(int(bad.sum()), count, "steps")
            found.append(f"step: {field} is {values[bad][0]} in {where}; it must be finite")
    for kind, contact in steps.contacts.items():
        bad = np.asarray(contact.infinite)
        if bad.any():
            states = number_of(int(bad.sum()), count, "states")
            found.append(
                f"features of the source of {kind!r} are not finite in {states}, of a hazard that "
                "is present; they must be finite"
            )
    return found


def wrong_ends(trial: Trial) -> list[str]:
    """Returns what is wrong with dangers, times, and the ends of episodes.

    Args:
        trial: the environment.
    """
    steps, limit = join(trial.steps, trial.placed), trial.limit
    outcome, time = steps.outcome, steps.reached.time
    count, before = len(time), steps.before.time
    allowed = f"the time limit is {limit}"
    terminated, truncated = np.asarray(outcome.terminated), np.asarray(outcome.truncated)
    cases = [
        (
            outcome.danger < 0,
            lambda i: f"step: danger is {outcome.danger[i]:.6g}",
            "it must be at least 0",
        ),
        (
            terminated & truncated,
            lambda i: f"step: terminated and truncated are both true at time {time[i]}",
            "at most one may be, and the time limit never hides a true end",
        ),
        (
            time != before + 1,
            lambda i: f"step: time goes from {before[i]} to {time[i]}",
            "it must count up by 1",
        ),
        (
            truncated & (before + 1 < limit),
            lambda i: f"step: truncated is true after step {before[i] + 1}",
            f"it must be false before the time limit, which is {limit}",
        ),
        (
            ~truncated & ~terminated & (before + 1 == limit),
            lambda i: f"step: truncated is false after step {before[i] + 1}",
            f"it must be true at the time limit, unless terminated is; {allowed}",
        ),
        (
            ~truncated & ~terminated & (before + 1 > limit),
            lambda i: f"step: the episode goes on after step {before[i] + 1}",
            f"it must end at any time from the limit on; {allowed}",
        ),
        (
            np.asarray(outcome.done) != (terminated | truncated),
            lambda i: f"step: done is {bool(outcome.done[i])} at time {time[i]}",
            "it must be true where terminated or truncated is, and only there",
        ),
    ]
    found = []
    for bad, text, rule in cases:
        if bad.any():
            where = number_of(int(bad.sum()), count, "steps")
            found.append(f"{text(int(np.argmax(bad)))} (in {where}); {rule}")
    return found + _wrong_starts(steps)


def _wrong_starts(steps: Steps) -> list[str]:
    """What is wrong with the states that `auto_reset_step` carries on."""
    found = []
    ended = np.asarray(steps.outcome.done)
    time = steps.carried.time[ended]
    if (time != 0).any():
        bad = number_of(int((time != 0).sum()), len(time), "starts")
        value = value_of(time[time != 0][:1])
        found.append(f"reset: time is {value} where an episode begins (in {bad}); it must be 0")
    kept = jax.tree.map(
        lambda a, b: np.array_equal(a, b, equal_nan=np.issubdtype(a.dtype, np.floating)),
        take(steps.carried, ~ended),
        take(steps.reached, ~ended),
    )
    if not all(jax.tree.leaves(kept)):
        found.append(
            "auto_reset_step carries on another state than step has reached, though the episode "
            "has not ended"
        )
    return found
