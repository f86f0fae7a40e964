"""Readers of meshes with named parts, by the ending of the file's name."""
