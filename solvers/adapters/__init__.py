"""One solver, one file: other people's solvers behind our protocol."""
