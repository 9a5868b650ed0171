"""An object without symmetry, for tests of what other programs read: a flipped axis makes another object of it."""

import numpy as np
import trimesh

from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import Segment, SegmentedMesh

NAMES = ("zebra head", "lost", "Öhrchen")
COLORS = ((86, 180, 233), (9, 9, 9), (3, 7, 255))
CENTER = np.array([0.1, 0.2, 0.5])
"""Of the box, in metres: different along all axes, and none of them 0."""

SIDES = np.array([0.02, 0.04, 0.08])


def segments() -> SegmentedMesh:
    """Names and colours that exporters tend to change: spaces, accents, dark colours; one segment without faces."""
    ball = trimesh.creation.icosphere(2, radius=0.01)
    box = trimesh.creation.box(SIDES)
    lost = Segment(NAMES[1], COLORS[1], np.empty((0, 3)), np.empty((0, 3), np.int64))
    return SegmentedMesh(
        (
            Segment(NAMES[0], COLORS[0], ball.vertices + CENTER - [0, 0.05, 0], np.array(ball.faces)),
            lost,
            Segment(NAMES[2], COLORS[2], box.vertices + CENTER, np.array(box.faces)),
        )
    )


def grid() -> LabelGrid:
    """The box is label 3, and the voxel at its corner with the largest x, y, z is label 1; 5 mm voxels, no cube."""
    labels = np.zeros((7, 11, 20), np.uint8)
    origin = np.array([0.085, 0.175, 0.4525])
    spacing = np.full(3, 0.005)
    places = np.stack(np.meshgrid(*(np.arange(n) for n in labels.shape), indexing="ij"), axis=-1) * spacing + origin
    labels[(np.abs(places - CENTER) <= SIDES / 2 + 1e-9).all(axis=-1)] = 3
    labels[tuple(np.argwhere(labels == 3).max(axis=0))] = 1
    return LabelGrid(labels, origin, spacing, NAMES)


def centroid(label: int) -> np.ndarray:
    """Of a label's voxels in ``grid``, in metres."""
    found = grid()
    return found.positions(np.argwhere(found.labels == label)).mean(axis=0)


def cloud() -> SegmentedCloud:
    points = np.array([[0.1, 0.2, 0.5], [0.11, 0.22, 0.54], [-0.1, 0.3, 0.7]])
    labels = np.array([3, 1, 3], np.uint8)
    return SegmentedCloud(points, labels, np.array([0.9, 0.6, 0.8]), np.array([0.5, 0.4, 0.01]), NAMES, COLORS)
