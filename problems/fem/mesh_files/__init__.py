"""Readers of meshes with named parts, selected by file name extension."""
