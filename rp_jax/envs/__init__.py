"""Environments: how bodies move, what is dangerous, and what is observed."""

from rp_jax.envs import circuit, jam, patrol, point_gather
from rp_jax.envs.contract import Env, Hazards, Outcome

__all__ = ["Env", "Hazards", "Outcome", "circuit", "jam", "patrol", "point_gather"]
