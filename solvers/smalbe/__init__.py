"""SMALBE: options, transformations of the QP, and the compiled algorithm."""
