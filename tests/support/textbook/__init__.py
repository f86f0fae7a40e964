"""SMALBE and MPRGP as a textbook has them, in NumPy: what tests compare ours with."""
