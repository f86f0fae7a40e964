"""Reference solvers, which use none of the solvers under test."""
