"""Safe reinforcement learning by reconnaissance and planning, in JAX."""
