"""Suites: TOML files that specify the cases, solvers and settings of a run."""
