"""Renderers of pages as HTML, Markdown and LaTeX, and of figures as files."""
