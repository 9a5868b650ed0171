"""Observed points with what the model says they are, for numpy; ``mereo.io.writers.ply`` has the PLY form."""

from pathlib import Path
from typing import Any

import numpy as np

from mereo.geometry.labels import SegmentedCloud
from mereo.io.atomic_files import atomic_file


def write_points_npz(path: str | Path, cloud: SegmentedCloud) -> None:
    """Write an NPZ file with the arrays of a ``SegmentedCloud``.

    They are ``points``, ``labels``, ``confidence``, ``occupancy``, ``names`` and ``colors``; ``names[k]`` and
    ``colors[k]`` are of label k + 1. ``confidence`` and ``occupancy`` are a network's, and left out without one.
    Positions are in the cloud's frame and unit.
    """
    chances: dict[str, Any] = dict(cloud.chances)
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            points=cloud.points,
            labels=cloud.labels,
            **chances,
            names=np.asarray(cloud.names),
            colors=np.asarray(cloud.colors, dtype=np.uint8),
        )
