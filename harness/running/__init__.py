"""Runs of a suite: schedule, engines on one machine or a cluster, and progress."""
