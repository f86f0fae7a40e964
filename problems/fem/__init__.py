"""Finite elements: meshes, stiffness matrices, generalised inverses and stresses."""
