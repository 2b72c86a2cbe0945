"""Whether features say all of a body and a hazard, and where the two may meet."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import join, repeat, take
from rp_jax.envs.check.comparison import LARGE, LEVEL, RARE, beyond, told_apart, tolerance_of
from rp_jax.envs.check.pairs import Pairs
from rp_jax.envs.check.problems import number_of, value_of
from rp_jax.envs.check.trial import Trial

MARGIN = 0.02  # of the range of a sampled feature, by which visited pairs may be outside
PAIRS = 512  # that are sampled, and that are visited
STEPS = 3
CASES, KEYS = 8, 512  # pairs that are stepped with many keys
WASTED = 0.25  # share of sampled pairs that may be out of reach


def wrong_features(trial: Trial) -> list[str]:
    """Returns where `state_of` and `features` do not invert one another.

    Args:
        trial: the environment.
    """
    found = []
    for pairs in trial.pairs.values():
        found += _lost(trial, pairs)
    return found


def _lost(trial: Trial, pairs: Pairs) -> list[str]:
    name = f"the source of {pairs.kind!r}"
    body, hazard = _some_pairs(trial, pairs)
    features = pairs.features(body, hazard)
    bad = ~np.isfinite(features).all(axis=1)
    if bad.any():
        where = number_of(int(bad.sum()), len(bad), "pairs that `sample` draws or that are visited")
        return [f"features of {name} are not finite for {where}; they must be finite"]
    again = pairs.restore(features)
    restored = pairs.features(*again)
    tolerance = tolerance_of(features, body, hazard)
    bad = beyond(features, restored, tolerance)
    if bad.mean() > RARE:
        row = int(np.argmax(bad))
        return [
            f"state_of of {name} does not invert `features` in "
            f"{number_of(int(bad.sum()), len(bad), 'pairs')}: from {value_of(features[row])} it "
            f"makes a pair with the features {value_of(restored[row])}; both must be the same"
        ]
    return _diverging(trial, pairs, (body, hazard), again, tolerance)


def _some_pairs(trial: Trial, pairs: Pairs) -> tuple[Any, Any]:
    """Pairs that are sampled, and visited ones that are in reach."""
    sampled, visited = pairs.sample(PAIRS), trial.visited(pairs.kind, PAIRS)
    reach = pairs.look(*visited)[2] if len(jax.tree.leaves(visited)[0]) else np.zeros(0, bool)
    return join(sampled, take(visited, reach))


def _diverging(
    trial: Trial, pairs: Pairs, one: Any, other: Any, tolerance: np.ndarray
) -> list[str]:
    """Pairs with the same features must come to the same features, whatever the world's frame."""
    start, count = (one, other), len(jax.tree.leaves(one)[0])
    worst = np.zeros(count, bool)
    for _ in range(STEPS):
        actions, keys = trial.draws.integers(count, trial.num_actions), trial.draws.keys(count)
        one, other = (_stepped(trial, pairs, pair, actions, keys) for pair in (one, other))
        got, wanted = pairs.features(*other), pairs.features(*one)
        worst |= beyond(got, wanted, 5 * tolerance)
    if worst.mean() <= 10 * RARE:
        return []
    # Noise may have a direction in the world's frame: then distributions must be the same.
    rows = trial.draws.among(np.flatnonzero(worst), CASES)
    actions = np.repeat(trial.draws.integers(CASES, trial.num_actions), KEYS)
    samples = []
    for pair in start:
        many = repeat(take(pair, rows), KEYS)
        for _ in range(STEPS):
            many = _stepped(trial, pairs, many, actions, trial.draws.keys(len(actions)))
        samples.append(pairs.features(*many).reshape(CASES, KEYS, -1))
    level = LEVEL / CASES
    apart = [told_apart(a, b, 5 * tolerance, level) for a, b in zip(*samples, strict=True)]
    if np.mean(apart) <= LARGE:
        return []
    return [
        f"features of the source of {pairs.kind!r} do not say all: in "
        f"{number_of(int(worst.sum()), count, 'pairs')}, the pair that `state_of` makes of them "
        f"comes to other features in {STEPS} steps than the original under the same actions and "
        "random numbers; what decides how body and hazard move must be among the features"
    ]


def _stepped(trial: Trial, pairs: Pairs, pair: Any, actions: Any, keys: Any) -> tuple[Any, Any]:
    body, hazard = pair
    return trial.away(body, actions), pairs.drift(keys, hazard, body)


def wrong_samples(trial: Trial) -> list[str]:
    """Returns where `sample` draws pairs out of reach, or hits are not in reach.

    Args:
        trial: the environment.
    """
    found = []
    for kind, pairs in trial.pairs.items():
        body, hazard = pairs.sample(4 * PAIRS)
        _, hit, reach = pairs.look(body, hazard)
        name = f"the source of {kind!r}"
        if np.mean(~reach) > WASTED:
            share = number_of(int((~reach).sum()), len(reach), "pairs")
            found.append(
                f"sample of {name} draws {share} for which in_reach is False; it must draw from "
                "those that are in reach"
            )
        found += _left_out(trial, pairs, (body, hazard))
        outside, hits = int((hit & ~reach).sum()), int(hit.sum())
        for steps in (trial.steps, trial.placed):
            contact = steps.contacts[kind]
            outside += int(contact.beyond.sum())
            hits += int(contact.hit.sum())
        if outside > RARE * hits:
            found.append(
                f"in_reach of {name} is False in {number_of(outside, hits, 'pairs')} that `hits` "
                "says are hit; what is hit must be in reach"
            )
    return found


def _left_out(trial: Trial, pairs: Pairs, sampled: tuple[Any, Any]) -> list[str]:
    """Returns a sentence if visited pairs in reach have features beyond those of sampled ones."""
    body, hazard = trial.visited(pairs.kind, PAIRS)
    if not len(jax.tree.leaves(body)[0]):
        return []
    features, _, reach = pairs.look(body, hazard)
    drawn, features = pairs.features(*sampled), features[reach]
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    slack = MARGIN * (high - low) + tolerance_of(drawn, *sampled)
    outside = (features < low - slack) | (features > high + slack)
    share = outside.mean(axis=0) if len(features) else np.zeros(1)
    worst = int(np.argmax(share))
    if share[worst] <= MARGIN:
        return []
    count = number_of(int(outside[:, worst].sum()), len(features), "visited pairs in reach")
    return [
        f"sample of the source of {pairs.kind!r} leaves out states that occur: feature {worst} is "
        f"in [{low[worst]:.6g}, {high[worst]:.6g}] where sampled, and outside in {count}, up to "
        f"[{features[:, worst].min():.6g}, {features[:, worst].max():.6g}]; it must draw all that "
        "may be in reach, every speed included"
    ]
