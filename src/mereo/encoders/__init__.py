"""Point cloud encoders: each maps a normalized cloud to a ``Code``."""
