"""A trolley with a swinging load among carts, simulated by brax."""
