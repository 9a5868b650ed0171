"""A ball of two labels as a volume of NIfTI."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Int
from numpy import ndarray
from numpy.linalg import norm

nibabel = pytest.importorskip("nibabel")


SPACING = np.array([1.5, 1.0, 2.5])


ORIGIN = np.array([-40.0, 7.0, 100.0])


CENTER = np.array([60.0, 70.0, 55.0])


RADIUS = 40.0


def halves() -> Int[ndarray, "80 140 44"]:
    """A ball of radius 40 mm as 1 (lower x) and 2, with a stray voxel of 7; position is index times spacing."""
    axes = [np.arange(n) * s for n, s in zip((80, 140, 44), SPACING, strict=True)]
    position = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - CENTER
    ball = norm(position, axis=-1) < RADIUS
    labels = np.where(ball, np.where(position[..., 0] < 0, 1, 2), 0)
    labels[0, 0, 0] = 7
    return labels.astype(np.int64)


def write_nifti(path: Path, labels: ndarray, flips: tuple[int, int, int] = (1, 1, 1)) -> Path:
    affine = np.diag([*(SPACING * flips), 1.0])
    affine[:3, 3] = ORIGIN
    nibabel.save(nibabel.Nifti1Image(labels.astype(np.uint8), affine), path)
    return path
