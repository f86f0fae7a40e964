"""Textbook versions of SMALBE and MPRGP in NumPy, with which tests compare results."""
