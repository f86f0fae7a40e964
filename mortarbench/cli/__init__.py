"""Command line: one module for each command, and `main` for all of them."""
