"""Whether the danger of a step is what the hazards and their sources foresee."""

import numpy as np

from rp_jax.envs.check.batches import join
from rp_jax.envs.check.problems import number_of
from rp_jax.envs.check.trial import Steps, Trial

TURNED = 1e-3  # share of hits that rounding may turn over, or one of several
TOUCHING = 1e-4  # of a clearance: rounding


def wrong_dangers(trial: Trial) -> list[str]:
    """Returns where danger, `collisions` and the hits of present hazards disagree.

    Args:
        trial: the environment.
    """
    steps = join(trial.steps, trial.placed)
    danger = ~(np.asarray(steps.outcome.danger) <= 0)  # nan is told elsewhere
    hit = {kind: contact.hit | contact.hit_before for kind, contact in steps.contacts.items()}
    found = []
    for kind, hits in hit.items():
        found += _unless_few(
            hits & ~danger,
            hits,
            "step: danger is 0 in",
            f"in which `hits` of the source of {kind!r} says that a hazard that is present is hit; "
            "it must be above 0 there",
        )
    cause = {kind: hits | steps.contacts[kind].gone for kind, hits in hit.items()}
    explained = np.any([np.zeros(len(danger), bool), *cause.values()], axis=0)
    fixed, under_plans = "", ""
    if trial.plans:
        explained |= np.asarray(steps.clearance) <= TOUCHING
        fixed = " and the clearance is above 0"
        under_plans = " or from a place where the clearance is 0 or less"
    found += _unless_few(
        danger & ~explained,
        danger,
        "step: danger is above 0 in",
        f"in which no hazard that is present is hit{fixed}; all danger must come from a hazard of "
        f"`hazards`{under_plans}, as the shield foresees no other",
    )
    return found + _wrong_collisions(steps, danger, hit, cause)


def _wrong_collisions(
    steps: Steps, danger: np.ndarray, hit: dict[str, np.ndarray], cause: dict[str, np.ndarray]
) -> list[str]:
    told = {kind: np.asarray(value) for kind, value in steps.collisions.items()}
    if not told:
        return []
    found = []
    for kind, hits in hit.items():
        found += _unless_few(
            hits & ~told[kind],
            hits,
            f"collisions: {kind!r} is False in",
            "in which `hits` of the source says that a hazard that is present is hit; it must be "
            "True there",
        )
        found += _unless_few(
            told[kind] & ~cause[kind],
            told[kind],
            f"collisions: {kind!r} is True in",
            "in which no hazard of that kind is hit; it must be False there",
        )
    anything = np.any([*told.values()], axis=0)
    return found + _unless_few(
        anything != danger,
        anything | danger,
        "collisions: they disagree with the danger of `step` in",
        "; some kind must be True where the danger is above 0, and only there",
    )


def _unless_few(bad: np.ndarray, among: np.ndarray, before: str, after: str) -> list[str]:
    """A sentence on how many of some steps are bad, unless rounding may be the reason."""
    count, most = int(bad.sum()), int(among.sum())
    if count == 0 or (count < most and count <= max(1, TURNED * most)):
        return []
    space = "" if after.startswith(";") else " "
    return [f"{before} {number_of(count, most, 'steps')}{space}{after}"]
