"""Solves on several MPI ranks: distributed vectors, failures and factorisation."""
