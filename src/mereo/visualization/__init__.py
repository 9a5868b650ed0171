"""Renderer, figures, reports, folders of results, and the viewer."""
