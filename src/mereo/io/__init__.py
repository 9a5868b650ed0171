"""File formats of every kind, in and out."""
