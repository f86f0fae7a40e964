"""Answers of all solvers held against one another and the truth."""
