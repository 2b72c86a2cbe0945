"""Learns the threat function of one sub-R-MDP: labels, fit, calibration, report (Algorithm 2)."""

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from rp_jax import statistics
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints, equal_chunks
from rp_jax.hazards import SubRMDP
from rp_jax.recon import labels, sampling
from rp_jax.threat import fit, report
from rp_jax.threat.fit import Dataset, FitConfig
from rp_jax.threat.model import ThreatModel, ThreatTable
from rp_jax.validate import finite, number, one_of, random_key, shared_length, within

Progress = Callable[[str, int, int], None]  # called with (stage, done, total)
SAMPLINGS = ("uniform", "preferential")
CHUNKS = 20  # parts of a fit; after each one there is a point of its curve, and a checkpoint


@dataclass(frozen=True)
class ThreatConfig:
    """Settings for learning the threat function of one kind of hazard.

    Attributes:
        tabled: label a grid of states, and look threats up at its nearest node, in place of fitting
            a network; for hazards whose threats are enumerated and whose source has a `grid`.
        states: number of labelled start states, or about that of the grid's nodes.
        paths: rollouts per state where the label is not exact.
        exact: label exactly where all rollouts can be enumerated.
        sampling: how start states are drawn: preferential or uniform.
        miss_rate: greatest share of unsafe states taken for safe; 1: no calibration.
        confidence: confidence that `miss_rate` is kept.
        test_states: number of fresh states for the report and the calibration.
        test_paths: rollouts per fresh state where the label is not exact.
        fit: settings of the fit.
    """

    tabled: bool = False
    states: int = 200_000
    paths: int = 64
    exact: bool = True
    sampling: str = "preferential"
    miss_rate: float = 0.02
    confidence: float = 0.95
    test_states: int = 2000
    test_paths: int = 8192
    fit: FitConfig = field(default_factory=FitConfig)

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        number(f"{name}.states", self.states, least=100, integer=True)
        number(f"{name}.paths", self.paths, least=2, integer=True)
        one_of(f"{name}.sampling", self.sampling, SAMPLINGS)
        number(f"{name}.miss_rate", self.miss_rate, above=0, most=1)
        number(f"{name}.confidence", self.confidence, above=0, most=0.999999)
        number(f"{name}.test_states", self.test_states, least=10, integer=True)
        number(f"{name}.test_paths", self.test_paths, least=2, integer=True)
        self.fit.validate(f"{name}.fit")
        first = self.states // 2 if self.sampling == "preferential" else self.states
        number(f"{name}.fit.validation", self.fit.validation, least=1 / first)


def check_config(kind: str, config: ThreatConfig, sub: SubRMDP) -> None:
    """Raises ValueError, naming the field, if settings do not suit a kind of hazard.

    Args:
        kind: of hazard, for the message.
        config: its settings.
        sub: its sub-R-MDP.
    """
    config.validate(kind)
    if config.tabled and not config.exact:
        raise ValueError(f"{kind}.exact is False; with tabled it must be True")
    if config.tabled and not can_table(sub):
        raise ValueError(
            f"{kind}.tabled is True; it must be False for hazards whose threats are not enumerated "
            "or whose source has no `grid`"
        )
    if config.tabled:
        with within(kind):
            _grid(sub, config.states)


def can_table(sub: SubRMDP) -> bool:
    """Returns whether the threats of a sub-R-MDP can be tabled on a grid of features.

    Args:
        sub: the sub-R-MDP.
    """
    return hasattr(sub.source, "grid") and labels.is_enumerable(sub)


class LearnedThreat(NamedTuple):
    """A threat model and how it was made."""

    model: ThreatModel
    curve: list[dict[str, float]]  # rows of step, loss, validation loss and validation error
    report: dict[str, Any]  # errors on freshly drawn states; see `report.compare`
    seconds: dict[str, float]  # duration of labels, fit and report


# Compiled as a whole: their operations one by one would take a minute to compile.
_preferential = jax.jit(sampling.preferential, static_argnames="count")
_split = jax.jit(fit.split, static_argnames="share")
_init = jax.jit(fit.init, static_argnames="config")
_run = jax.jit(fit.run, static_argnames=("config", "steps"), donate_argnames="state")
_logits = jax.jit(ThreatModel.logits)


def _labelled(key, features, sub, estimator, stage, on_progress, mesh, checkpoints) -> Dataset:
    """Returns the states with these features, labelled."""
    body, hazard = sampling.states(sub, features)
    watch = (lambda done, total: on_progress(stage, done, total)) if on_progress else None
    at = checkpoints.at(stage)
    found = labels.label(
        key, body, hazard, sub, estimator, on_progress=watch, mesh=mesh, checkpoints=at
    )
    return Dataset(features, found.threat)


@jax.jit
def _validated(model: ThreatModel, params: Any, held: Dataset) -> tuple[Array, Array]:
    """Returns cross entropy and mean absolute error on held-out states."""
    logits = model.replace(params=params).logits(held.features)
    error = jnp.mean(jnp.abs(jax.nn.sigmoid(logits) - held.threat))
    return fit.cross_entropy(logits, held.threat), error


def fitted(
    key: Array,
    sub: SubRMDP,
    data: Dataset,
    config: FitConfig,
    on_progress: Progress | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> tuple[ThreatModel, list[dict[str, float]]]:
    """Fits a model to labelled states and their mirror images.

    The number of steps is that of the settings or slightly more, so that the fit divides into
    `CHUNKS` equal parts.

    Args:
        key: random key for the initial weights and the order of the states.
        sub: the sub-R-MDP.
        data: labelled states.
        config: settings of the fit.
        on_progress: called with ("fit", steps done, steps).
        checkpoints: where to save the state of the fit.

    Returns:
        The fitted model, and its curve: rows of step, loss, validation loss and validation error.

    Raises:
        ValueError: a setting is out of range, or features and threats differ in number.
        FloatingPointError: a loss or a weight is not a finite number.
    """
    random_key("key", key)
    config.validate("config")
    shared_length(features=data.features, threat=data.threat)
    split_key, init_key = jax.random.split(key)
    train, held = _split(split_key, data, share=config.validation)
    train = fit.mirror(train, sub)
    model, state = _init(init_key, sub, train, config=config)
    chunks, length = equal_chunks(config.steps, CHUNKS)
    config = dataclasses.replace(config, steps=length * chunks)

    def step(i: int, carried: tuple[fit.FitState, np.ndarray]) -> tuple[fit.FitState, np.ndarray]:
        state, losses = _run(model, carried[0], train, config=config, steps=length)
        finite("fit: losses", losses)
        finite("fit: weights", np.concatenate([np.ravel(a) for a in jax.tree.leaves(state.params)]))
        carried[1][i] = [np.mean(losses), *_validated(model, state.params, held)]
        if on_progress:
            on_progress("fit", (i + 1) * length, config.steps)
        return state, carried[1]

    blank = np.zeros((chunks, 3), held.threat.dtype)
    params, points = checkpoints.loop(
        (state, blank), step, chunks, lambda carried: (carried[0].params, carried[1])
    )
    names = ("loss", "validation_loss", "validation_mae")
    curve = [
        {"step": (i + 1) * length, **dict(zip(names, point, strict=True))}
        for i, point in enumerate(points.tolist())
    ]
    return model.replace(params=params), curve


def tabled(
    key: Array,
    sub: SubRMDP,
    nodes: int,
    on_progress: Progress | None = None,
    mesh: Mesh | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> ThreatModel:
    """Returns a table of exact threats on the grid of a hazard's features.

    Args:
        key: passed on to the estimator, which does not use it.
        sub: the sub-R-MDP, for which `can_table` holds.
        nodes: about how many.
        on_progress: called with ("labels", states done, states).
        mesh: devices that share the nodes; None for one device.
        checkpoints: where to save labels that are done.
    """
    low, step, shape, grid = _grid(sub, nodes)
    features = jnp.asarray(grid, float)
    estimator = labels.exact_threat
    data = _labelled(key, features, sub, estimator, "labels", on_progress, mesh, checkpoints)
    smallest = float(jnp.finfo(data.threat.dtype).eps)  # whose logit is still finite
    threat = jnp.clip(data.threat, smallest, 1 - smallest)
    values = {"low": low, "step": step, "logits": jnp.log(threat) - jnp.log1p(-threat)}
    params = {"params": {name: jnp.asarray(value, float) for name, value in values.items()}}
    network = ThreatTable(shape, data.threat.shape[1])
    return ThreatModel(sub.source, params, jnp.ones(len(shape)), jnp.zeros(()), network)


def _grid(sub: SubRMDP, nodes: int) -> tuple[Any, Any, tuple[int, ...], np.ndarray]:
    """Returns what `grid` of a source says, checked, and the nodes (n, F) of that grid."""
    low, step, shape = sub.source.grid(sub.body, nodes)
    drawn = lambda key: sub.source.features(*sub.source.sample(key, sub.body))  # noqa: E731
    (wanted,) = jax.eval_shape(drawn, jax.random.key(0)).shape
    lengths = len(low), len(step), len(shape)
    if set(lengths) != {wanted}:
        raise ValueError(
            "grid of the source: the first node, the steps and the numbers of nodes have the "
            f"lengths {lengths}; each must be {wanted}, as `features` has"
        )
    axes = [low[k] + step[k] * np.arange(count) for k, count in enumerate(shape)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, wanted)
    some = jnp.asarray(grid[:: max(1, len(grid) // 100)], float)
    again = jax.vmap(sub.source.features)(*sampling.states(sub, some))
    if not np.allclose(again, some, atol=1e-4):
        raise ValueError("grid of the source: its nodes must be features, which state_of inverts")
    return low, step, shape, grid


class Calibration(NamedTuple):
    """A statement on a calibrated model, for states drawn like those it was calibrated on."""

    rate: float  # bound of the share, among states with an unsafe action, that have one called safe
    confidence: float  # probability, over the draw of the states, with which the bound holds
    states: int  # number of states drawn
    unsafe_states: int  # how many of them have an action with a threat above x
    missed: int  # how many of these still have such an action called safe


def calibrated(
    model: ThreatModel, data: Dataset, x: float, rate: float, confidence: float
) -> tuple[ThreatModel, Calibration]:
    """Shifts small logits up until few states have an unsafe action called safe.

    An action is unsafe if its label exceeds x, and called safe if the model's threat is at most x.
    The shift is the least one for which the exact upper confidence bound of the share of such
    states is at most `rate`: an order statistic of the shift that each state needs, as in
    split-conformal prediction. The bound holds for any model, provided that the states are
    independent of each other and of the fit. Where there are too few unsafe states to show the
    rate, none is let through, and the result says which rate that shows. Logits are never shifted
    down; those above x move less the greater they are, since they are called unsafe anyway.

    Args:
        model: the model as fitted, not shifted yet.
        data: labelled states, independent of each other and of the fit.
        x: threshold; outside (0, 1) no shift could change a decision, and the model is returned as
            it is.
        rate: greatest share of the states with an unsafe action that may have one called safe.
        confidence: level of the confidence bound.

    Returns:
        The shifted model, and the statement that holds for it.
    """
    unsafe = np.asarray(data.threat, float) > x  # not rounded to the labels' precision
    counted = unsafe.any(axis=1)
    n = int(counted.sum())
    if n == 0 or not 0 < x < 1:
        return model, Calibration(1.0, confidence, len(unsafe), n, 0)
    knee = np.log(x / (1 - x))
    short = np.where(unsafe, knee - np.asarray(_logits(model, data.features)), -np.inf)
    needed = np.sort(short.max(axis=1)[counted])[::-1]
    allowed = max(0, statistics.events_allowed(n, rate, confidence))
    shift = max(0.0, float(needed[allowed]) + 1e-4)
    missed = int((needed > shift).sum())
    bound = statistics.upper_bound(allowed, n, confidence)
    facts = Calibration(bound, confidence, len(unsafe), n, missed)
    return model.replace(shift=jnp.asarray(shift), knee=jnp.asarray(knee, model.knee.dtype)), facts


def near_threshold(key: Array, sub: SubRMDP, model: ThreatModel, x: float, most: int) -> Array:
    """Draws features of states whose threats are near x, independent of each other.

    States are drawn uniformly, and each is kept with probability `sampling.interest` of the threats
    that the model predicts.

    Args:
        key: random key.
        sub: the sub-R-MDP.
        model: predicts threats.
        x: threshold.
        most: greatest number of states to return.

    Returns:
        (n, F) features, n <= most.
    """
    pool, kept = _thinned(key, sub, model, x, 20 * most)
    return jnp.asarray(np.asarray(pool)[np.flatnonzero(kept)[:most]])


@functools.partial(jax.jit, static_argnames="count")
def _thinned(
    key: Array, sub: SubRMDP, model: ThreatModel, x: float, count: int
) -> tuple[Array, Array]:
    """Returns features drawn uniformly, and which of them are kept."""
    draw_key, keep_key = jax.random.split(key)
    pool = sampling.uniform(draw_key, sub, count)
    odds = jnp.minimum(sampling.interest(model(pool), x), 1.0)
    return pool, jax.random.bernoulli(keep_key, odds)


def _training_data(
    keys: Array,
    sub: SubRMDP,
    config: ThreatConfig,
    x: float,
    estimator: labels.Estimator,
    on_progress: Progress | None,
    mesh: Mesh | None,
    checkpoints: Checkpoints,
) -> Dataset:
    """Returns the labelled states that a network is fitted to."""
    first = config.states // 2 if config.sampling == "preferential" else config.states
    features = sampling.uniform(keys[0], sub, first)
    at = checkpoints.at
    data = _labelled(keys[1], features, sub, estimator, "labels", on_progress, mesh, checkpoints)
    if config.sampling == "preferential":
        short = dataclasses.replace(config.fit, steps=max(1, config.fit.steps // 4))
        scout, _ = fitted(keys[2], sub, data, short, on_progress, checkpoints=at("scout"))
        more = _preferential(
            keys[3], sub, scout, data.features, data.threat, x, count=config.states - first
        )
        extra = _labelled(
            keys[4], more, sub, estimator, "more labels", on_progress, mesh, checkpoints
        )
        data = Dataset(*map(jnp.concatenate, zip(data, extra, strict=True)))
    jax.block_until_ready(data)
    return data


def learn_threat(
    key: Array,
    sub: SubRMDP,
    config: ThreatConfig,
    x: float,
    on_progress: Progress | None = None,
    mesh: Mesh | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> LearnedThreat:
    """Learns the threat function of one kind of hazard.

    Args:
        key: random key for all steps.
        sub: the sub-R-MDP.
        config: settings.
        x: threshold at which the report counts wrong decisions, and near which preferential
            sampling and calibration look for states.
        on_progress: called with (stage, done, total).
        mesh: devices that share the rollouts; None for one device.
        checkpoints: where to save labels and fits that are done.

    Returns:
        The model, its learning curve, a report on freshly drawn states, and durations.

    Raises:
        ValueError: a setting is out of range.
        FloatingPointError: a label, a loss or a weight is not a finite number.
    """
    random_key("key", key)
    check_config("config", config, sub)
    number("x", x, least=0, infinite=True)
    keys = jax.random.split(key, 9)
    estimator = labels.best_estimator(sub, config.paths, config.exact)
    accurate = labels.best_estimator(sub, config.test_paths)
    began, at = time.perf_counter(), checkpoints.at
    if config.tabled:
        model = tabled(keys[1], sub, config.states, on_progress, mesh, checkpoints)
        labelled = time.perf_counter()
        curve: list[dict[str, float]] = []
    else:
        data = _training_data(keys, sub, config, x, estimator, on_progress, mesh, checkpoints)
        labelled = time.perf_counter()
        model, curve = fitted(keys[5], sub, data, config.fit, on_progress, checkpoints=at("fit"))
    facts = {}
    if config.miss_rate < 1:
        hard = near_threshold(keys[8], sub, model, x, config.test_states)
        checked = _labelled(
            keys[6], hard, sub, accurate, "calibration", on_progress, mesh, checkpoints
        )
        rate, confidence = config.miss_rate, config.confidence
        model, known = calibrated(model, checked, x, rate, confidence)
        facts = {"calibration": known._asdict()}
    fitted_at = time.perf_counter()
    fresh_key, test_key = jax.random.split(keys[7])
    fresh = sampling.uniform(fresh_key, sub, config.test_states)
    test = _labelled(test_key, fresh, sub, accurate, "report", on_progress, mesh, checkpoints)
    found = report.compare(np.asarray(report.predict(model, fresh)), np.asarray(test.threat), x)
    seconds = {
        "labels": labelled - began,
        "fit": fitted_at - labelled,
        "report": time.perf_counter() - fitted_at,
    }
    return LearnedThreat(
        model, curve, {**found, "x": x, "shift": float(model.shift), **facts}, seconds
    )
