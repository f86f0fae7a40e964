"""The reference solve, which shares no code with the solvers under test."""
