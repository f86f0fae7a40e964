"""Finite elements: meshes, stiffness, generalised inverses and stresses."""
