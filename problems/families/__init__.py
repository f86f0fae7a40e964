"""Families of contact problems, one per module, with their base classes."""
