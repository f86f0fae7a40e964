"""Runs of a suite: schedule, executor on one machine or on a cluster, and progress."""
