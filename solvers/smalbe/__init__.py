"""SMALBE: the algorithm as it is written, and compiled."""
