"""Cameras, meshes, clouds, label grids, and queries on them."""
