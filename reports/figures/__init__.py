"""Figures as values: content, style and the measurements behind each point."""
