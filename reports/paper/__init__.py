"""Figures and tables of the paper from stored measurements."""
