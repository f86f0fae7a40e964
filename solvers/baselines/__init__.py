"""In-house solvers to compare with: active sets, projected gradients, least squares."""
