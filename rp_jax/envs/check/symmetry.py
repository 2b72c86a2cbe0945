"""Whether the mirrored situation, left and right exchanged, behaves like the mirror image."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import repeat, take
from rp_jax.envs.check.comparison import LARGE, LEVEL, RARE, beyond, told_apart, tolerance_of
from rp_jax.envs.check.pairs import Pairs
from rp_jax.envs.check.problems import number_of, value_of
from rp_jax.envs.check.trial import Trial

PAIRS = 1024
STEPS = 2  # under one action
CASES, KEYS = 8, 512  # pairs that are stepped with many keys


def asymmetries(trial: Trial) -> list[str]:
    """Returns where features are mirrored otherwise than actions, hits or random moves.

    Args:
        trial: the environment.
    """
    found: list[str] = []
    if not hasattr(trial.model, "mirrored_threats"):
        return found
    for pairs in trial.pairs.values():
        if hasattr(pairs.source, "mirrored"):
            found += _of_kind(trial, pairs)
    return found


def _of_kind(trial: Trial, pairs: Pairs) -> list[str]:
    name = f"the source of {pairs.kind!r}"
    pair = pairs.sample(PAIRS)
    pair = take(pair, np.isfinite(pairs.features(*pair)).all(axis=1))  # others are told elsewhere
    features = pairs.features(*pair)
    if not len(features):
        return []
    image = pairs.mirror(features)
    tolerance = tolerance_of(features, *pair)
    bad = beyond(pairs.mirror(image), features, tolerance)
    if bad.any():
        row = int(np.argmax(bad))
        twice, where = pairs.mirror(image)[row], number_of(int(bad.sum()), len(bad), "pairs")
        return [
            f"mirrored of {name} takes the features {value_of(features[row])} to {value_of(twice)} "
            f"when it is applied twice (in {where}); the mirror image of a mirror image must be "
            "the original"
        ]
    if beyond(pairs.features(*pairs.restore(features)), features, tolerance).mean() > RARE:
        return []  # what is wrong with `state_of` is told elsewhere
    other = pairs.restore(image)
    bad = beyond(pairs.features(*other), image, tolerance)
    if bad.mean() > RARE:
        row, where = int(np.argmax(bad)), number_of(int(bad.sum()), len(bad), "pairs")
        return [
            f"mirrored of {name} gives features that no pair has, such as {value_of(image[row])} "
            f"(in {where}); `state_of` must find a pair with the mirrored features"
        ]
    found = _hits_differ(name, pairs, pair, other)
    found += _actions_differ(trial, name, pairs, pair, other, tolerance)
    return found or _chances_differ(trial, name, pairs, pair, other, tolerance)


def _hits_differ(name: str, pairs: Pairs, pair: Any, other: Any) -> list[str]:
    hit, image = pairs.look(*pair)[1], pairs.look(*other)[1]
    bad, either = int((hit != image).sum()), int((hit | image).sum())
    if bad <= 1 or bad <= 0.02 * either:
        return []
    return [
        f"mirrored of {name} takes hits to situations without a hit, or the other way, in "
        f"{number_of(bad, either, 'pairs')} with a hit; `hits` must be the same for mirror images"
    ]


def _actions_differ(
    trial: Trial, name: str, pairs: Pairs, pair: Any, other: Any, tolerance: np.ndarray
) -> list[str]:
    """The body moves, the hazard is held."""
    images = np.asarray(trial.model.mirrored_threats())
    rows, count = len(jax.tree.leaves(pair)[0]), trial.num_actions
    index = trial.draws.integers(rows, len(images))
    (plans, actions), (their_plans, theirs) = (
        (i // count, (i % count).astype(np.int32)) for i in (index, images[index])
    )
    bad, (body, twin) = np.zeros(rows, bool), (pair[0], other[0])
    for k in range(STEPS):
        follow = k - 1 if trial.plans else -1  # the plan, after the first action
        choice, their_choice = ((i + 0.5) / (len(images) // count) for i in (plans, their_plans))
        body = trial.away(body, actions, follow, choice)
        twin = trial.away(twin, theirs, follow, their_choice)
        got, wanted = pairs.features(twin, other[1]), pairs.mirror(pairs.features(body, pair[1]))
        bad |= beyond(got, wanted, 5 * tolerance)
    if bad.mean() <= 10 * RARE:
        return []
    worst = int(np.argmax(np.bincount(index[bad], minlength=len(images))))
    return [
        f"mirrored of {name} and params.body.mirrored_threats do not fit together in "
        f"{number_of(int(bad.sum()), len(bad), 'pairs')}, most with index {worst}, whose mirror "
        f"image is said to be {images[worst]}: from mirrored situations, mirrored actions must "
        "lead to mirrored features"
    ]


def _chances_differ(
    trial: Trial, name: str, pairs: Pairs, pair: Any, other: Any, tolerance: np.ndarray
) -> list[str]:
    """The hazard moves, and the body under the baseline policy: alike in distribution."""
    rows = trial.draws.among(np.arange(len(jax.tree.leaves(pair)[0])), CASES)
    actions = np.zeros(CASES * KEYS, np.int32)
    samples = []
    for bodies, hazards in (pair, other):
        body, hazard = (repeat(take(tree, rows), KEYS) for tree in (bodies, hazards))
        for _ in range(STEPS):
            moved = pairs.drift(trial.draws.keys(len(actions)), hazard, body)
            choice = trial.draws.uniform(len(actions))
            body, hazard = trial.away(body, actions, k=0, choice=choice), moved
        samples.append(pairs.features(body, hazard))
    image = pairs.mirror(samples[0]).reshape(CASES, KEYS, -1)
    other_side = samples[1].reshape(CASES, KEYS, -1)
    level = LEVEL / CASES
    apart = [told_apart(a, b, 5 * tolerance, level) for a, b in zip(image, other_side, strict=True)]
    if np.mean(apart) <= LARGE:
        return []
    return [
        f"mirrored of {name} does not hold of what is random: in "
        f"{number_of(sum(apart), CASES, 'pairs')}, {STEPS} steps of the hazard and of the baseline "
        "policy, mirrored, lead to other features than such steps from the mirrored situation; "
        "both must have the same distribution"
    ]
