"""Deformable objects: the type, the built-in ones, and those that users define in files."""
