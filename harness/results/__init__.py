"""A result folder: its lines, its faults, and a run stored in it."""
