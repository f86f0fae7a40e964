"""Worker processes of a run: protocol, limits and measurements."""
