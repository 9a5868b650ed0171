"""What a scene file says of an object of which only the meshes are known: how it bends, and from where it is seen.

The object is taken for rubber that deforms about as much as those of the built-in scenes. A lattice alone is too stiff
for that: the bound that keeps space from folding over limits it. So the object bends along its longest side, and two
lattices of cubes follow, one after the other, all scaled until the surface moves by ``MOTION``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.maps import Deformation
from mereo.deformation.samplers import RandomMotion, distance_from_line
from mereo.geometry.mesh import SegmentedMesh, surface_points
from mereo.geometry.transforms import Normalizer, fit_rigid, inverse_rigid, transform_points
from mereo.scenes.files.deformation_blocks import BendBlock, DeformationBlock, LatticeBlock, Target
from mereo.scenes.scene import Workspace
from mereo.scenes.seeds import example_rng

# --- how far states move ----------------------------------------------------------------------------------------------

# How far an object moves in its random states: what its shape changes by, beyond turns and shifts of the whole.

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


# --- defaults ---------------------------------------------------------------------------------------------------------

MOTION = 0.05
"""Motion of the surface in a typical state, in longest sides: that of the bunny and of the liver."""

LATTICES = 2

MOST_STRENGTH = 0.9

MOST_BEND_DEG = 120.0

BEND_SHARE = 0.8
"""Largest bend, as a share of that at which space folds over; ``samplers.FOLD_SHARE`` is the bound."""

NEAR = 100.0
"""Nearest distance of the camera, as in the paper, in scene units; farther for what would fill a wider view."""

FARTHER = 1.25
"""Farthest distance, in nearest ones. Twice, as in the paper, leaves a quarter of the picture's pixels."""

MOST_VIEW_RAD = float(np.deg2rad(40.0))

VIEWS = 64

FRAMED = 1000
"""Places of the surface that a view must show, and at most so many vertices of each segment."""

MARGIN = 1.03
"""Width of the picture, in widths of the widest of ``VIEWS`` views from the nearest distance."""


UNPLACED = Normalizer(np.zeros(3), 1.0)


def default_deformations(mesh: SegmentedMesh) -> tuple[BendBlock | LatticeBlock, ...]:
    """Deformations under which the surface moves by about ``MOTION``, or by as much as does not fold space over.

    Args:
        mesh: segments in the file's frame and unit.
    """
    strength = 1.0
    for _ in range(4):  # motion is nearly proportional to the strength
        blocks = _blocks(mesh, strength)
        moved = motion(mesh, random_motion(mesh, blocks, UNPLACED)).mean
        if abs(moved / MOTION - 1) < 0.02 or (moved < MOTION and strength == 1.0):
            break
        strength = min(strength * MOTION / moved, 1.0)
    return _blocks(mesh, strength)


def _blocks(mesh: SegmentedMesh, strength: float) -> tuple[BendBlock | LatticeBlock, ...]:
    """A bend along the longest side and ``LATTICES`` lattices, numbers rounded as they are written."""
    low, high = mesh.bounds
    longest = int((high - low).argmax())
    origin, axis, length = (low + high) / 2, np.eye(3)[longest], float((high - low)[longest])
    origin[longest] = low[longest]
    radius = distance_from_line(mesh.merged()[0], origin, axis)
    most = min(BEND_SHARE * np.rad2deg(length / radius), MOST_BEND_DEG)
    x, y, z = (rounded(value) for value in origin)
    angle, size = float(np.floor(most * strength)), rounded(length)
    share = rounded(MOST_STRENGTH * strength, 2)
    bend = BendBlock(type="bend", origin=(x, y, z), axis=_direction(longest), length=size, angle=(-angle, angle))
    return (bend, *(LATTICES * [LatticeBlock(type="lattice", spacing=rounded(length / 2), strength=share)]))


def _direction(index: int) -> tuple[float, float, float]:
    x, y, z = np.eye(3)[index]
    return float(x), float(y), float(z)


def rounded(value: float, digits: int = 4) -> float:
    """Value with so many digits that count."""
    return float(f"{value:.{digits}g}")


def random_motion(mesh: SegmentedMesh, blocks: tuple[DeformationBlock, ...], placement: Normalizer) -> RandomMotion:
    """Maps that blocks draw for all segments of a mesh, which is placed already."""
    everything = tuple(range(len(mesh.segments)))
    target = Target(mesh, mesh.bounds, placement)
    return RandomMotion(mesh, tuple((block.sampler(target), everything) for block in blocks))


# --- the camera -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class View:
    """Where the camera is by default.

    Attributes:
        near, far: its distances from the object's centre, in scene units.
        field_of_view: angle in whole degrees.
    """

    near: float
    far: float
    field_of_view: int


def default_view(rest: SegmentedMesh, draw: Draw, workspace: Workspace) -> View:
    """Distances and a field of view that random states fill without being cut.

    Args:
        rest: segments in scene units.
        draw: their maps in a random state.
        workspace: directions from which the camera looks.
    """
    states = _states(rest, draw)
    reach = max(float(np.linalg.norm(points - center, axis=1).max()) for points, center in states)
    near = max(NEAR, float(np.ceil(reach / np.sin(MOST_VIEW_RAD / 2))))
    widest = 0.0
    for index, (points, center) in enumerate(states):
        pose = workspace.sample(example_rng(1, index), center)
        pose[:3, 3] = center - near * pose[:3, 2]
        seen = transform_points(inverse_rigid(pose), points)
        widest = max(widest, float(np.abs(seen[:, :2] / seen[:, 2:]).max()))
    view = int(np.clip(np.ceil(np.rad2deg(2 * np.arctan(MARGIN * widest))), 5, 90))
    return View(near, float(np.ceil(FARTHER * near)), view)


def _states(rest: SegmentedMesh, draw: Draw) -> list[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "3"]]]:
    """Places of the surface in random states, and the middle of their box, at which the camera aims."""
    points, owner = material_points(rest, FRAMED)
    corners = [segment.vertices[:: 1 + len(segment.vertices) // FRAMED] for segment in rest.segments]
    owner = np.concatenate([owner, np.repeat(np.arange(len(corners)), [len(part) for part in corners])])
    points = np.concatenate([points, *corners])
    moved = [move(points, owner, draw(example_rng(0, index))) for index in range(VIEWS)]
    return [(places, (places.min(axis=0) + places.max(axis=0)) / 2) for places in moved]
