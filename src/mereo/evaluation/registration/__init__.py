"""Placement of a model on a real scan, which makes the truth for scans of your own."""
