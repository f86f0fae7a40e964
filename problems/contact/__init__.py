"""Contact of elastic bodies: contact sides, contact rows, friction and load steps."""
