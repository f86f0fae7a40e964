"""Families of problems, with their base classes."""
