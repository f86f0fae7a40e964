"""Models of families of elastic bodies in space."""
