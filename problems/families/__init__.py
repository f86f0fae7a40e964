"""Families of contact problems, one per module, and what only they share."""
