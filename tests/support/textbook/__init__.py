"""Textbook versions of SMALBE and MPRGP in NumPy, as oracles of tests."""
