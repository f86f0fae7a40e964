"""Contact in space between faces and nodes, and between faces."""
