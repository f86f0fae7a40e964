"""Models behind the families: meshes, materials, loads and exact solutions."""
