"""Convex sets that constrain the variables of a QP."""
