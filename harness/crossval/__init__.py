"""Comparison of the answers of all solvers with each other and with references."""
