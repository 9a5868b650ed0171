"""How far an object moves in its random states: what its shape changes by, beyond turns and shifts of the whole."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh, surface_points
from mereo.geometry.transforms import fit_rigid, transform_points
from mereo.scenes.seeds import example_rng

STATES = 24

POINTS = 800
"""Places of the surface at which motion is measured."""

Draw = Callable[[np.random.Generator], tuple[Deformation, ...]]


@dataclass(frozen=True)
class Motion:
    """Motion of the surface in a typical (median) state, in shares of the object's longest side.

    Attributes:
        mean: root mean square over the surface, after the best rigid motion of the whole.
        largest: that of the place which moves farthest, likewise.
    """

    mean: float
    largest: float


def motion(rest: SegmentedMesh, draw: Draw, states: int = STATES) -> Motion:
    """Motion of an object in ``states`` random states, which are the same in every call."""
    points, owner = material_points(rest, POINTS)
    length = float((rest.bounds[1] - rest.bounds[0]).max())
    means, most = [], []
    for index in range(states):
        moved = move(points, owner, draw(example_rng(0, index)))
        way = np.linalg.norm(moved - transform_points(fit_rigid(points, moved), points), axis=1) / length
        means.append(np.sqrt(np.mean(way**2)))
        most.append(way.max())
    return Motion(float(np.median(means)), float(np.median(most)))


def move(
    points: Float[np.ndarray, "n 3"], owner: Int[np.ndarray, " n"], deformations: tuple[Deformation, ...]
) -> Float[np.ndarray, "n 3"]:
    """Points of segments (indices ``owner``), each moved by its segment's map."""
    result = np.empty_like(points)
    for index in np.unique(owner):
        rows = owner == index
        result[rows] = deformations[index](points[rows])
    return result


def material_points(mesh: SegmentedMesh, count: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Points evenly spread over the surface of all segments, and the index of the segment of each."""
    vertices, faces, owner = mesh.merged()
    points, face = surface_points(vertices, faces, count)
    return points, owner[face]
