"""Command line: one module per command, and `main`, which parses the arguments."""
