"""SMALBE: the algorithm from the solver's face down to its compiled kernels."""
