"""In-house solvers for comparison: active sets, projected gradients, least squares."""
