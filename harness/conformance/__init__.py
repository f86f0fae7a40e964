"""Checks that a solver conforms to its contract, and the manufactured QPs they use."""
