"""Visualization: renderer, figures, reports, folders of results, and the viewer in a browser."""
