"""Distributed solves: vectors over MPI ranks, collective failures, factorisation."""
