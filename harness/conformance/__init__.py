"""Checks that a solver conforms to its contract, and manufactured QPs for them."""
