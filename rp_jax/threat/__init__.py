"""Threat functions: learned per kind of hazard, summed over hazards (Theorem 3)."""
