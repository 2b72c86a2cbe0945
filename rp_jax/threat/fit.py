"""Supervised learning of a threat function from labelled states (paper, appendix G.1)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from rp_jax.hazards import SubRMDP
from rp_jax.threat.model import ACTIVATIONS, DEEPEST, WIDEST, ThreatModel, ThreatNetwork
from rp_jax.validate import number, one_of, shown


class Dataset(NamedTuple):
    """Labelled states of one sub-R-MDP."""

    features: Array  # (n, F)
    threat: Array  # (n, A)


@dataclass(frozen=True)
class FitConfig:
    """How a threat model is fitted."""

    hidden: tuple[int, ...] = (128, 64)
    activation: str = "silu"
    steps: int = 10_000
    batch: int = 1024
    learning_rate: float = 3e-3
    epsilon: float = 1e-8  # Adam's
    cosine: bool = True  # else a constant rate
    validation: float = 0.05  # share of the states held out

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        if not isinstance(self.hidden, tuple) or not 0 < len(self.hidden) <= DEEPEST:
            allowed = f"1 to {DEEPEST} widths"
            raise ValueError(f"{name}.hidden is {shown(self.hidden)}; it must be {allowed}")
        for width in self.hidden:
            number(f"{name}.hidden", width, least=1, most=WIDEST, integer=True)
        one_of(f"{name}.activation", self.activation, ACTIVATIONS)
        number(f"{name}.steps", self.steps, least=1, integer=True)
        number(f"{name}.batch", self.batch, least=1, integer=True)
        number(f"{name}.learning_rate", self.learning_rate, above=0)
        number(f"{name}.epsilon", self.epsilon, above=0)
        number(f"{name}.validation", self.validation, above=0, most=0.9)


class FitState(NamedTuple):
    """Carried through the fit."""

    params: Any
    opt_state: optax.OptState
    key: Array


def mirror(data: Dataset, sub: SubRMDP) -> Dataset:
    """Adds the left-right mirror image of every row: the sub-R-MDP is symmetric."""
    swapped = data.threat[:, sub.agent.mirrored_threats()]
    return Dataset(
        features=jnp.concatenate([data.features, sub.source.mirrored(data.features)]),
        threat=jnp.concatenate([data.threat, swapped]),
    )


def split(key: Array, data: Dataset, share: float) -> tuple[Dataset, Dataset]:
    """(training, validation) rows, drawn at random."""
    n = len(data.features)
    held = round(n * share)
    order = jax.random.permutation(key, n)
    part = lambda rows: jax.tree.map(lambda a: a[rows], data)  # noqa: E731
    return part(order[held:]), part(order[:held])


def cross_entropy(logits: Array, threat: Array) -> Array:
    """Mean cross entropy; unbiased under noisy labels, least at their expectation."""
    return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, threat))


def optimiser(config: FitConfig) -> optax.GradientTransformation:
    """Adam, with the rate falling to zero along a cosine unless told otherwise."""
    rate = config.learning_rate
    schedule = optax.cosine_decay_schedule(rate, config.steps) if config.cosine else rate
    return optax.adam(schedule, eps=config.epsilon)


def init(
    key: Array, sub: SubRMDP, data: Dataset, config: FitConfig
) -> tuple[ThreatModel, FitState]:
    """A fresh model whose inputs are scaled by the spread of the data, and its fit's state."""
    network = ThreatNetwork(config.hidden, data.threat.shape[-1], config.activation)
    begin, onward = jax.random.split(key)
    params = network.init(begin, data.features[:1])
    scale = 1.0 / (jnp.std(data.features, axis=0) + 1e-6)
    model = ThreatModel(sub.source, params, scale, jnp.zeros(()), network)
    return model, FitState(params, optimiser(config).init(params), onward)


def run(
    model: ThreatModel, state: FitState, data: Dataset, config: FitConfig, steps: int
) -> tuple[FitState, Array]:
    """`steps` gradient steps in one scan. Returns the state and the loss of each step."""
    transform = optimiser(config)

    def loss(params, features, threat):
        return cross_entropy(model.replace(params=params).logits(features), threat)

    def step(state: FitState, _):
        key, draw = jax.random.split(state.key)
        rows = jax.random.randint(draw, (config.batch,), 0, len(data.features))
        value, grads = jax.value_and_grad(loss)(
            state.params, data.features[rows], data.threat[rows]
        )
        updates, opt_state = transform.update(grads, state.opt_state, state.params)
        return FitState(optax.apply_updates(state.params, updates), opt_state, key), value

    return jax.lax.scan(step, state, None, length=steps)
