"""How good a threat model is where it matters: for single hazards, and for the sum over them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

from rp_jax import statistics
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.dynamics import num_threats
from rp_jax.envs.contract import Hazards
from rp_jax.recon import labels
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.total import counted


def compare(predicted: np.ndarray, true: np.ndarray, x: float) -> dict[str, float]:
    """Compares predicted threats with true ones, and the decisions that follow at a threshold.

    An action is unsafe if its true threat exceeds x, and called safe if its predicted one does not.

    Args:
        predicted: (n, A) threats of n states.
        true: (n, A) threats of the same states.
        x: threshold.

    Returns:
        A table with the errors `mae`, `rmse` and `bias` (predicted less true); `spearman`, the rank
        correlation (nan if either side is constant); `unsafe` and `safe`, the numbers of unsafe and
        safe actions; `unsafe_called_safe`, the share of the unsafe ones that are called safe;
        `safe_called_unsafe`, the share of the safe ones that are called unsafe; `unsafe_states`,
        the number of states with an unsafe action; `states_missed`, how many of these have one
        called safe; and `states_missed_upper95`, the one-sided exact 95 % bound of their share.
    """
    predicted, true = np.asarray(predicted, float), np.asarray(true, float)  # x is not rounded
    missed = (true > x) & (predicted <= x)
    states, of = int(missed.any(axis=-1).sum()), int((true > x).any(axis=-1).sum())
    predicted, true = np.ravel(predicted), np.ravel(true)
    error = predicted - true
    unsafe, called = true > x, predicted > x
    constant = np.ptp(predicted) == 0 or np.ptp(true) == 0
    return {
        "mae": float(np.abs(error).mean()),
        "rmse": float(np.sqrt(np.square(error).mean())),
        "bias": float(error.mean()),
        "spearman": float("nan") if constant else float(stats.spearmanr(predicted, true)[0]),
        "unsafe": int(unsafe.sum()),
        "safe": int((~unsafe).sum()),
        "unsafe_called_safe": float((unsafe & ~called).sum() / max(1, unsafe.sum())),
        "safe_called_unsafe": float((~unsafe & called).sum() / max(1, (~unsafe).sum())),
        "unsafe_states": of,
        "states_missed": states,
        "states_missed_upper95": statistics.upper_bound(states, of) if of else 1.0,
    }


@jax.jit
def predict(model: ThreatModel, features: Array) -> Array:
    """Returns a model's threats, 0 where the hazard is out of reach, as in `total_threat`.

    Args:
        model: the model.
        features: (n, F).

    Returns:
        (n, A).
    """
    reached = jax.vmap(lambda row: model.source.in_reach(*model.source.state_of(row)))(features)
    return jnp.where(reached[:, None], model(features), 0.0)


def labelled_sum(
    key: Array,
    bodies: Any,
    hazards: Hazards,
    sub: Any,
    estimator: labels.Estimator,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> np.ndarray:
    """Returns the sum over hazards of their estimated threats, which a model's sum should equal.

    Args:
        key: random key for the estimator.
        bodies: states of the body, leading axis (B,).
        hazards: hazards of one kind, leading axes (B, n).
        sub: the kind's sub-R-MDP.
        estimator: estimates the threats of one body and one hazard.
        checkpoints: where to save the labels that are done.

    Returns:
        (B, A).
    """
    reached = np.asarray(jax.jit(counted)(sub.source, bodies, hazards))
    row, column = np.nonzero(reached)
    total = np.zeros((reached.shape[0], num_threats(sub.body)))
    if len(row):
        body = jax.tree.map(lambda a: a[row], bodies)
        hazard = jax.tree.map(lambda a: a[row, column], hazards.state)
        found = labels.label(key, body, hazard, sub, estimator, checkpoints=checkpoints)
        np.add.at(total, row, np.asarray(found.threat, float))
    return total
