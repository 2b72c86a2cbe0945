"""How good a threat model is, where it matters: single hazards, and the sum over them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

from rp_jax import statistics
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.envs.base import Hazards
from rp_jax.recon import labels
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.total import counted


def compare(predicted: np.ndarray, true: np.ndarray, x: float) -> dict[str, float]:
    """Errors of predicted against true threats (n, A) of n states, and decisions at x.

    Returns:
        mae, rmse, bias (predicted less true), spearman (nan if either is constant);
        unsafe_called_safe: of the pairs truly above x, the share predicted at most x;
        safe_called_unsafe: of the pairs truly at most x, the share predicted above; and the number
        of pairs of either kind. unsafe_states: those with an unsafe action; states_missed: of
        these, those with one called safe, and the one-sided exact 95 % bound of their share.
    """
    missed = (true > x) & (np.asarray(predicted) <= x)
    states, of = int(missed.any(axis=-1).sum()), int((true > x).any(axis=-1).sum())
    predicted, true = np.ravel(predicted).astype(float), np.ravel(true).astype(float)
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
    """(n, A) threats of features (n, F); 0 for what is out of reach, as `total_threat` has it."""
    reached = jax.vmap(lambda row: model.source.in_reach(*model.source.state_of(row)))(features)
    return jnp.where(reached[:, None], model(features), 0.0)


def labelled_sum(
    key: Array,
    agents: Any,
    hazards: Hazards,
    sub: Any,
    estimator: labels.Estimator,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> np.ndarray:
    """(B, A) sum over hazards of their estimated threats: what a model's sum should be.

    Args:
        key: of the estimator.
        agents: leading axis (B,).
        hazards: of one kind, leading axes (B, n).
        sub: their sub-R-MDP.
        estimator: labels a single (agent, hazard).
        checkpoints: of the labels.
    """
    reached = np.asarray(jax.jit(counted)(sub.source, agents, hazards))
    row, column = np.nonzero(reached)
    total = np.zeros((reached.shape[0], sub.agent.num_threats))
    if len(row):
        agent = jax.tree.map(lambda a: a[row], agents)
        hazard = jax.tree.map(lambda a: a[row, column], hazards.state)
        found = labels.label(key, agent, hazard, sub, estimator, checkpoints=checkpoints)
        np.add.at(total, row, np.asarray(found.threat, float))
    return total
