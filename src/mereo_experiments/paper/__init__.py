"""Experiments of the paper, one module each: ``mereo experiment NAME`` repeats a table or figure.

Each module has ``run(store, scale)``, which makes or finds what it needs and returns a ``Result``.
"""
