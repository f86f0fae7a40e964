"""Reference solvers, which share no code with the solvers under test."""
