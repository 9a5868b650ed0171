"""Cameras, meshes, clouds, label grids, and what can be asked of them."""
