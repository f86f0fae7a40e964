"""Figures as data: content, style and the measurements behind each point."""
