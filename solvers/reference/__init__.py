"""Reference solves, computed without code of the solvers under test."""
