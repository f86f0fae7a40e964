"""In-house solvers other than SMALBE, for comparison with SMALBE and libraries."""
