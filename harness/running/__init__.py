"""What a run does, in which order, and where."""
