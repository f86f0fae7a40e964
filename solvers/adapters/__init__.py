"""Adapters from solver libraries to the `Solver` protocol, one file per library."""
