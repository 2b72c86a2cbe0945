"""Threat functions: learned for each kind of hazard, and summed over hazards (Theorem 3)."""
