"""Three-dimensional contact: node to face, and mortar contact between faces."""
