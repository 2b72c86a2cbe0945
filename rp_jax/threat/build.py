"""Algorithm 2, lines 1 and 2: labels, fit and report of one sub-R-MDP's threat function."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax.hazards import SubRMDP
from rp_jax.recon import labels, sampling
from rp_jax.threat import fit, report
from rp_jax.threat.fit import Dataset, FitConfig
from rp_jax.threat.model import ThreatModel
from rp_jax.validate import number, one_of

Progress = Callable[[str, int, int], None]  # (stage, done, total)
SAMPLINGS = ("uniform", "preferential")


@dataclass(frozen=True)
class ThreatConfig:
    """How the threat function of one kind of hazard is learned."""

    states: int = 200_000  # labelled start states
    paths: int = 64  # rollouts per state, where the label is not exact
    sampling: str = "uniform"  # of the start states: uniform or preferential
    prudence: float = 1.0  # most unsafe pairs to be called safe, of hard ones; 1: as fitted
    test_states: int = 2000  # fresh states that the report is made on
    test_paths: int = 8192  # rollouts per fresh state, where the label is not exact
    fit: FitConfig = field(default_factory=FitConfig)

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        number(f"{name}.states", self.states, least=100, integer=True)
        number(f"{name}.paths", self.paths, least=2, integer=True)
        one_of(f"{name}.sampling", self.sampling, SAMPLINGS)
        number(f"{name}.prudence", self.prudence, above=0, most=1)
        number(f"{name}.test_states", self.test_states, least=10, integer=True)
        number(f"{name}.test_paths", self.test_paths, least=2, integer=True)
        self.fit.validate(f"{name}.fit")


class Built(NamedTuple):
    """A threat model and how it came about."""

    model: ThreatModel
    curve: list[dict[str, float]]  # step, loss, validation loss and error
    report: dict[str, Any]  # on a fresh draw; see `report.compare`
    seconds: dict[str, float]  # labels, fit, report


def _labelled(key, features, sub, estimator, stage, on_progress) -> Dataset:
    agent, hazard = jax.vmap(sub.source.state_of)(features)
    watch = (lambda done, total: on_progress(stage, done, total)) if on_progress else None
    found = labels.label(key, agent, hazard, sub, estimator, on_progress=watch)
    return Dataset(features, found.threat)


_run = jax.jit(fit.run, static_argnames=("config", "steps"), donate_argnames="state")


def fitted(
    key: Array,
    sub: SubRMDP,
    data: Dataset,
    config: FitConfig,
    on_progress: Progress | None = None,
    chunks: int = 20,
) -> tuple[ThreatModel, list[dict[str, float]]]:
    """Fits a model to labelled states and their mirror images; returns it and its curve."""
    split_key, init_key = jax.random.split(key)
    train, held = fit.split(split_key, data, config.validation)
    train = fit.mirror(train, sub)
    model, state = fit.init(init_key, sub, train, config)
    length = max(1, config.steps // chunks)
    config = dataclasses.replace(config, steps=length * chunks)
    curve = []
    for i in range(chunks):
        state, loss = _run(model, state, train, config=config, steps=length)
        now = model.replace(params=state.params)
        logits = now.logits(held.features)
        error = jnp.mean(jnp.abs(jax.nn.sigmoid(logits) - held.threat))
        curve.append(
            {
                "step": (i + 1) * length,
                "loss": float(jnp.mean(loss)),
                "validation_loss": float(fit.cross_entropy(logits, held.threat)),
                "validation_mae": float(error),
            }
        )
        if on_progress:
            on_progress("fit", (i + 1) * length, config.steps)
    return model.replace(params=state.params), curve


def prudent(model: ThreatModel, data: Dataset, x: float, rate: float) -> ThreatModel:
    """Shifts the logits up until at most `rate` of the pairs truly above x are called safe.

    The shift is never downwards. Outside 0 < x < 1 no shift could change a decision.
    """
    unsafe = np.asarray(data.threat) > x
    if not unsafe.any() or not 0 < x < 1:
        return model
    short = np.log(x / (1 - x)) - np.asarray(model.logits(data.features))[unsafe]
    shift = max(0.0, float(np.quantile(short, 1 - rate, method="higher")) + 1e-4)
    return model.replace(shift=model.shift + shift)


def build(
    key: Array,
    sub: SubRMDP,
    config: ThreatConfig,
    x: float,
    on_progress: Progress | None = None,
) -> Built:
    """Learns the threat function of one kind of hazard.

    Args:
        key: of everything random in it.
        sub: the sub-R-MDP.
        config: sizes.
        x: the threshold at which the report counts wrong decisions, and preferential sampling
            and prudence look closely.
        on_progress: told how far each stage is.
    """
    keys = jax.random.split(key, 9)
    estimator = labels.best_estimator(sub, config.paths)
    accurate = labels.best_estimator(sub, config.test_paths)
    began = time.perf_counter()
    first = config.states // 2 if config.sampling == "preferential" else config.states
    features = sampling.uniform(keys[0], sub, first)
    data = _labelled(keys[1], features, sub, estimator, "labels", on_progress)
    if config.sampling == "preferential":
        short = dataclasses.replace(config.fit, steps=config.fit.steps // 4)
        scout, _ = fitted(keys[2], sub, data, short, on_progress)
        more = sampling.preferential(
            keys[3], sub, scout, data.features, data.threat, x, config.states - first
        )
        extra = _labelled(keys[4], more, sub, estimator, "labels", on_progress)
        data = Dataset(*map(jnp.concatenate, zip(data, extra, strict=True)))
    jax.block_until_ready(data)
    labelled = time.perf_counter()
    model, curve = fitted(keys[5], sub, data, config.fit, on_progress)
    if config.prudence < 1:
        pool = sampling.uniform(keys[8], sub, 20 * config.test_states)
        order = jnp.argsort(-sampling.interest(model(pool), x))
        hard = pool[order[: config.test_states]]
        checked = _labelled(keys[6], hard, sub, accurate, "prudence", on_progress)
        model = prudent(model, checked, x, config.prudence)
    fitted_at = time.perf_counter()
    fresh_key, test_key = jax.random.split(keys[7])
    fresh = sampling.uniform(fresh_key, sub, config.test_states)
    test = _labelled(test_key, fresh, sub, accurate, "report", on_progress)
    found = report.compare(np.asarray(report.predict(model, fresh)), np.asarray(test.threat), x)
    seconds = {
        "labels": labelled - began,
        "fit": fitted_at - labelled,
        "report": time.perf_counter() - fitted_at,
    }
    return Built(model, curve, {**found, "x": x, "shift": float(model.shift)}, seconds)
