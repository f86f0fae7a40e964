"""Solves on several ranks: communicators, linear maps and sparse factors."""
