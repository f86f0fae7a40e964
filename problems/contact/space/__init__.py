"""Contact in space: node to face, and mortar contact between faces."""
