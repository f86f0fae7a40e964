"""What was measured, read and grouped the way that reports ask for it."""
