"""Adapters from solver libraries to our protocol, one file for each library."""
