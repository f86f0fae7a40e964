"""Comparison of two result folders: changes, conclusions and their pages."""
