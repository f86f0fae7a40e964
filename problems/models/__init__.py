"""Models of the families: meshes, materials, loads and exact solutions."""
