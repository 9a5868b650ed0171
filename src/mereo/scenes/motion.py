"""How far an object moves in its random states: what its shape changes by, beyond turns and shifts of the whole."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh
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
    points, owner = surface_points(rest, POINTS)
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


def surface_points(mesh: SegmentedMesh, count: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Points evenly spread over the surface of all segments, and the index of the segment of each.

    Vertices would not do: a CAD program's are where a surface is round, none where it is flat.
    """
    vertices, faces, owner = mesh.merged()
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen], owner[chosen]
