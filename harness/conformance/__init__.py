"""Conformance checks and weaknesses of solvers, with manufactured QPs to test them."""
