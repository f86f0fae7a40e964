"""Reference solves, which share no code with the solvers under test."""
