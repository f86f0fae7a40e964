"""Worker processes of a run: their protocol, their limits and measurements in them."""
