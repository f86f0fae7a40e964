"""Communicators of one solve, linear maps and sparse factors."""
