"""Methods to compare with: constrained policy gradients, and model predictive control."""
