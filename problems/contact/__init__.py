"""Contact of elastic bodies: contact sides, their rows, friction and load steps."""
