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

    features: Array  # (n, F) features of the states
    threat: Array  # (n, A) their threats, the labels


@dataclass(frozen=True)
class FitConfig:
    """Settings for fitting a threat model.

    Attributes:
        hidden: widths of the network's hidden layers.
        activation: relu or silu.
        steps: number of gradient steps.
        batch: states per gradient step.
        learning_rate: Adam's learning rate.
        epsilon: Adam's epsilon.
        cosine: let the rate fall to 0 along a cosine; otherwise it is constant.
        validation: share of the states held out for validation.
    """

    hidden: tuple[int, ...] = (128, 128, 128)
    activation: str = "silu"
    steps: int = 12_000
    batch: int = 1024
    learning_rate: float = 3e-3
    epsilon: float = 1e-8
    cosine: bool = True
    validation: float = 0.05

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
    """The state of a fit between two steps."""

    params: Any  # weights of the network
    opt_state: optax.OptState  # state of the optimiser
    key: Array  # random key of the next step


def mirror(data: Dataset, sub: SubRMDP) -> Dataset:
    """Adds the left-right mirror image of every row, where the sub-R-MDP has that symmetry.

    Args:
        data: labelled states.
        sub: the sub-R-MDP; without the symmetry the data is returned unchanged.
    """
    if not (hasattr(sub.body, "mirrored_threats") and hasattr(sub.source, "mirrored")):
        return data
    swapped = data.threat[:, sub.body.mirrored_threats()]
    return Dataset(
        features=jnp.concatenate([data.features, sub.source.mirrored(data.features)]),
        threat=jnp.concatenate([data.threat, swapped]),
    )


def split(key: Array, data: Dataset, share: float) -> tuple[Dataset, Dataset]:
    """Splits rows at random into a training and a validation set.

    Args:
        key: random key.
        data: labelled states.
        share: fraction of the rows in the validation set.

    Returns:
        (training set, validation set).
    """
    n = len(data.features)
    held = round(n * share)
    order = jax.random.permutation(key, n)
    part = lambda rows: jax.tree.map(lambda a: a[rows], data)  # noqa: E731
    return part(order[held:]), part(order[:held])


def cross_entropy(logits: Array, threat: Array) -> Array:
    """Returns the mean cross entropy of predictions.

    It is unbiased under noise of the labels, and least where the predictions are their
    expectations.

    Args:
        logits: (..., A) predicted logits.
        threat: (..., A) labels in [0, 1].

    Returns:
        () mean over all elements.
    """
    return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, threat))


def optimiser(config: FitConfig) -> optax.GradientTransformation:
    """Returns Adam with the learning rate of the settings.

    Args:
        config: settings; with `cosine` the rate falls to 0 along a cosine.
    """
    rate = config.learning_rate
    schedule = optax.cosine_decay_schedule(rate, config.steps) if config.cosine else rate
    return optax.adam(schedule, eps=config.epsilon)


def init(
    key: Array, sub: SubRMDP, data: Dataset, config: FitConfig
) -> tuple[ThreatModel, FitState]:
    """Returns a new model and the state of its fit.

    The model's inputs are scaled by the spread of the data.

    Args:
        key: random key for the weights and the fit.
        sub: the sub-R-MDP.
        data: labelled states; only their shape and spread matter.
        config: settings of the fit.
    """
    network = ThreatNetwork(config.hidden, data.threat.shape[-1], config.activation)
    begin, onward = jax.random.split(key)
    params = network.init(begin, data.features[:1])
    scale = 1.0 / (jnp.std(data.features, axis=0) + 1e-6)
    model = ThreatModel(sub.source, params, scale, jnp.zeros(()), network)
    return model, FitState(params, optimiser(config).init(params), onward)


def run(
    model: ThreatModel, state: FitState, data: Dataset, config: FitConfig, steps: int
) -> tuple[FitState, Array]:
    """Makes gradient steps, all in one scan.

    Args:
        model: the model; its weights are those of `state`.
        state: the state of the fit.
        data: labelled states to draw batches from.
        config: settings of the fit.
        steps: number of steps.

    Returns:
        The state after the steps, and the loss (steps,) of each step.
    """
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
