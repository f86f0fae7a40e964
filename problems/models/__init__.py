"""What the families build: meshes, materials, loads and exact solutions."""
