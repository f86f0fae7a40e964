"""Figures as values: what is drawn, how it looks, and the measurements behind it."""
