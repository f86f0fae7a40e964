"""Suites: TOML files that specify measurements."""
