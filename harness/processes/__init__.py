"""Processes of a run: workers, their protocol with the parent, limits and measuring."""
