"""Renderers: a page as HTML, Markdown and LaTeX, and its figures as files."""
