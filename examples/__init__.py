"""Worlds that are none of rp_jax: environments of one's own, on the same code."""
