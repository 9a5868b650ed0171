"""Views with their observations."""

import numpy as np
from toy_data import half_balls

from mereo_learning.dataset import Draws


def observed(rng: np.random.Generator, points: int, queries: int) -> dict[str, np.ndarray]:
    """Half balls, and three halves of their cloud, of which the last has fewer points."""
    row = half_balls(rng, points, queries)
    cloud, half = row["cloud"], points // 2
    parts = [cloud[:half], cloud[-half:], cloud[10:40]]
    seen = np.stack([part[np.arange(points) % len(part)] for part in parts]).astype(np.float16)
    return row | {"seen": seen, "seen_count": np.array([len(part) for part in parts], dtype=np.int32)}


def rng(seed: int = 0) -> Draws:
    return Draws.of(seed)
