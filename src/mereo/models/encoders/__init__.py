"""Point cloud encoders: each maps a normalized cloud to an ``Encoding``."""
