"""Finite elements: meshes, stiffness, its generalised inverses, and stresses."""
