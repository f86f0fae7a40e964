"""Contact of faces with nodes and faces in space."""
