"""Carry: what is defined in the rest model comes to where the object is, its inside included.

Attachment -place-> Placed (rest model, scene units) -carry-> Carried (frame and unit of a registration)

Volumes are resampled by ``resampled``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy.ndimage import map_coordinates

from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids, label_grid
from mereo.geometry.subdivision import split_long_edges
from mereo.geometry.transforms import best_rotations, transform_points
from mereo.io.attachments import Attachment, Content, Placeable, Surfaces
from mereo.io.config import CarryFrame
from mereo.io.volume_files import Volume, is_labels
from mereo.scenes.scene import SourceFrame
from mereo.scenes.statistical_model import StatisticalModel

# --- volumes ----------------------------------------------------------------------------------------------------------

# Volumes along a registration: each voxel of a grid around the object asks what was there at rest.
#
# output voxel -to_rest-> rest model, scene units -T_index_scene-> voxel index of the source -interpolation-> value
#
# ``Registration.to_rest`` takes a minute for a million points, so it is asked at the corners of cells of 4 voxels, then
# of 2, and linearly interpolated in those at whose centre that is right; in all others every voxel is asked.

Interpolation = Literal["auto", "linear", "nearest"]
"""Linear for intensities, nearest for labels; "auto" tells them apart (``is_labels``)."""

MOST_VOXELS = 16_000_000
"""Voxels of a grid at most; with more its spacing is widened."""

MARGIN = 0.05
"""Width of what is carried around the object, of half the rest box's longest side."""

CELLS = (4, 2)
"""Voxels along the sides of the cells in which rest positions are interpolated, one after the other."""

TOLERANCE = 0.04
"""Voxels of the source by which that may be off at a cell's centre. Elsewhere in it, where the nearest material points
change, it is up to twice as much: inside the object less than 0.1."""

QUERIES_AT_ONCE = 2000
"""Points that ``to_rest`` is asked about at once: of more its weights leave the cache, and it takes twice as long."""

CELLS_AT_ONCE = 1024
POINTS_AT_ONCE = 500_000

SAMPLES = 24
"""Places along each axis of a volume at which it is asked whether it lies in the object."""

CUBE = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)


@dataclass(frozen=True, eq=False)
class Resampled:
    """Volume where a registered object is.

    Attributes:
        volume: in the registration's frame and unit.
        inside: number of its voxels that lie inside a segment.
        within: how many of these were within the source's voxels at rest; the others have the background's value.
        interpolation: which was used.
    """

    volume: Volume
    inside: int
    within: int
    interpolation: Interpolation


def resampled(
    source: Volume,
    registration: Registration,
    interpolation: Interpolation = "auto",
    background: float | None = None,
    spacing: float | None = None,
    most: int = MOST_VOXELS,
) -> Resampled:
    """A volume that was defined in the rest model, on a grid around the registered object.

    Voxels inside the object have the source's value where they were at rest, and so have those around it, up to
    ``MARGIN``, as if they moved along with the nearest segment. All others have the background's value.

    Args:
        source: its ``T_world_index`` leads to scene units of the rest model.
        registration: of the object.
        interpolation: "linear", "nearest", or "auto": nearest for labels, linear for all else.
        background: value elsewhere, in the source's own meaning (after its slope and intercept); by default its least.
        spacing: between voxel centres, in the registration's unit; by default the source's finest, widened where the
            grid would have more than ``most`` voxels.
        most: voxels of the grid.

    Raises ``ValueError`` for a background that the source's type cannot hold.
    """
    wanted = float(source.spacing.min()) * registration.scene_unit if spacing is None else spacing
    margin = MARGIN * registration.model.half * registration.scene_unit
    grid = _Grid.around(registration.mesh.bounds, margin, wanted, most)
    owner, inside = grid.owners(registration.solids, margin)
    if interpolation == "auto":
        interpolation = "nearest" if is_labels(source) else "linear"
    sampler = _Sampler(source, interpolation, _stored(source, background))
    values = np.full(grid.shape, sampler.background, dtype=source.values.dtype)
    within = 0
    for label in range(1, len(registration.mesh.segments) + 1):
        within += _fill(values, owner == label, label, inside, grid, registration, sampler)
    volume = replace(source, values=values, T_world_index=grid.T_world_index)
    return Resampled(volume, int(inside.sum()), within, interpolation)


def check_overlap(
    name: str, volume: Volume, T_scene_file: Float[np.ndarray, "4 4"], model: StatisticalModel, solids: Solids
) -> None:
    """Raise ``ValueError`` for a volume, in scene units, without any voxel in the object."""
    if volume.holds(volume.index_of(model.rest_points)).any():
        return
    ticks = [np.linspace(-0.5, n - 0.5, SAMPLES) for n in volume.values.shape]
    sample = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    if solids.label(transform_points(volume.T_world_index, sample)).any():
        return
    volume_extent, object_extent = (
        " to ".join(str(corner.round(2).tolist()) for corner in _box(np.linalg.inv(T_scene_file), bounds))
        for bounds in (volume.bounds, model.rest.bounds)
    )
    raise ValueError(
        f"{name} holds nothing of the object: in RAS its voxels lie from {volume_extent}, and the object's own files "
        f"from {object_extent}; both must have one frame and unit: export the volume in that of the object's own "
        "files, or say --carry-frame scene if it is in scene units"
    )


def _box(T: Float[np.ndarray, "4 4"], bounds: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Axis-aligned box around a transformed box."""
    corners = transform_points(T, np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _stored(source: Volume, background: float | None) -> float | int:
    """Value of the background as it is stored; by default that of the least value."""
    if background is None:
        return (source.values.max() if source.slope < 0 else source.values.min()).item()
    value = (background - source.intercept) / source.slope
    if source.values.dtype.kind == "f":
        return value
    limits = np.iinfo(source.values.dtype)
    if not limits.min <= round(value) <= limits.max:
        raise ValueError(
            f"the background is {background:g}; the volume's type {source.values.dtype} holds "
            f"{source.slope * limits.min + source.intercept:g} to {source.slope * limits.max + source.intercept:g}: "
            "choose a value between them"
        )
    return round(value)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Axis-aligned grid, whose sides are multiples of the largest cell's.

    Attributes:
        shape: voxels along each axis.
        origin: centre of voxel [0, 0, 0].
        spacing: between voxel centres.
    """

    shape: tuple[int, int, int]
    origin: Float[np.ndarray, "3"]
    spacing: float

    @classmethod
    def around(cls, bounds: Float[np.ndarray, "2 3"], margin: float, spacing: float, most: int) -> "_Grid":
        """Grid over a box and a margin, with at most so many voxels."""
        size, cell = bounds[1] - bounds[0] + 2 * margin, CELLS[0]
        while True:
            cells = np.maximum(np.ceil(size / (cell * spacing)).astype(np.int64), 1)
            if (count := int(cells.prod()) * cell**3) <= max(most, cell**3):
                break
            spacing *= max((count / most) ** (1 / 3), 1.01)
        shape = (cell * int(cells[0]), cell * int(cells[1]), cell * int(cells[2]))
        return cls(shape, bounds.mean(axis=0) - (np.array(shape) - 1) * spacing / 2, spacing)

    @property
    def T_world_index(self) -> Float[np.ndarray, "4 4"]:
        """From voxel indices to positions."""
        transform = np.diag([*[self.spacing] * 3, 1.0])
        transform[:3, 3] = self.origin
        return transform

    def at(self, index: np.ndarray) -> Float[np.ndarray, "*n 3"]:
        """Positions of voxel indices, which may have fractions."""
        return self.origin + self.spacing * index

    def owners(self, solids: Solids, margin: float) -> tuple[UInt8[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
        """Label of the segment that each voxel moves along with, 0 beyond the margin, and whether it is inside it."""
        x, y, z = (self.origin[axis] + self.spacing * np.arange(self.shape[axis]) for axis in range(3))
        owner = label_grid(solids.mesh, x, y, z)
        inside = owner > 0
        side = CELLS[0]
        cells = np.argwhere(np.ones([n // side for n in self.shape], dtype=bool))
        reach = margin + np.sqrt(3) / 2 * side * self.spacing
        near = cells[solids.nearest(self.at(side * cells + (side - 1) / 2)).distance <= reach]
        rows = _flat(side * near[:, None] + _offsets(side), self.shape).ravel()
        rows = rows[owner.ravel()[rows] == 0]
        for first in range(0, len(rows), POINTS_AT_ONCE):
            part = rows[first : first + POINTS_AT_ONCE]
            nearest = solids.nearest(self.at(np.stack(np.unravel_index(part, self.shape), axis=1)))
            owner.reshape(-1)[part] = np.where(nearest.distance <= margin, nearest.owner + 1, 0)
        return owner, inside


@dataclass(frozen=True, eq=False)
class _Sampler:
    """Values of a source between its voxels; outside them the background."""

    source: Volume
    interpolation: Interpolation
    background: float | int

    def __call__(self, index: Float[np.ndarray, "n 3"]) -> tuple[Shaped[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Values at indices with fractions, as they are stored, and whether these lie in a voxel."""
        values, held = self.source.values, self.source.holds(index)
        if self.interpolation == "nearest":
            nearest = np.clip(np.rint(index).astype(np.int64), 0, np.array(values.shape) - 1)
            sampled = values[tuple(nearest.T)]
        else:
            smooth = map_coordinates(values, index.T, order=1, mode="nearest", output=np.float64)
            sampled = (np.rint(smooth) if values.dtype.kind in "iu" else smooth).astype(values.dtype)
        sampled[~held] = self.background
        return sampled, held


def _fill(
    values: Shaped[np.ndarray, "x y z"],
    todo: Bool[np.ndarray, "x y z"],
    label: int,
    inside: Bool[np.ndarray, "x y z"],
    grid: _Grid,
    registration: Registration,
    sampler: _Sampler,
) -> int:
    """Put the values of one segment's voxels, ``todo``, in place; returns how many inside were within the source."""
    flat, open_, of_object = values.reshape(-1), todo.reshape(-1), inside.reshape(-1)
    within = 0

    def put(rows: Int[np.ndarray, " n"], index: Float[np.ndarray, "n 3"]) -> int:
        flat[rows], held = sampler(index)
        open_[rows] = False
        return int((held & of_object[rows]).sum())

    for side in CELLS:
        blocks = todo.reshape([part for n in grid.shape for part in (n // side, side)]).any(axis=(1, 3, 5))
        cells = np.argwhere(blocks)
        corners, right = _corners(cells, side, label, grid, registration, sampler.source)
        weights = _trilinear(side)
        cells, corners = cells[right], corners[right]
        for first in range(0, len(cells), CELLS_AT_ONCE):
            part = slice(first, first + CELLS_AT_ONCE)
            rows = _flat(side * cells[part, None] + _offsets(side), grid.shape)
            wanted = open_[rows]
            within += put(rows[wanted], (weights @ corners[part])[wanted])
    left = np.flatnonzero(open_)
    for first in range(0, len(left), POINTS_AT_ONCE):
        rows = left[first : first + POINTS_AT_ONCE]
        places = grid.at(np.stack(np.unravel_index(rows, grid.shape), axis=1))
        within += put(rows, _source_index(places, label, registration, sampler.source))
    return within


def _corners(
    cells: Int[np.ndarray, "n 3"], side: int, label: int, grid: _Grid, registration: Registration, source: Volume
) -> tuple[Float[np.ndarray, "n 8 3"], Bool[np.ndarray, " n"]]:
    """Indices in the source of cells' corners, and whether they may be interpolated, judged by the cells' centres."""
    shape = [n // side + 1 for n in grid.shape]
    nodes, place = np.unique(_flat(cells[:, None] + CUBE, shape), return_inverse=True)
    at_nodes = side * np.stack(np.unravel_index(nodes, shape), axis=1)
    corners = _source_index(grid.at(at_nodes), label, registration, source)[place.reshape(-1, 8)]
    centers = _source_index(grid.at(side * (cells + 0.5)), label, registration, source)
    return corners, np.linalg.norm(corners.mean(axis=1) - centers, axis=1) <= TOLERANCE


def _source_index(
    places: Float[np.ndarray, "n 3"], label: int, registration: Registration, source: Volume
) -> Float[np.ndarray, "n 3"]:
    """Voxel indices, with fractions, of where places were at rest that move along with a segment."""
    rest = np.empty_like(places)
    for first in range(0, len(places), QUERIES_AT_ONCE):
        part = places[first : first + QUERIES_AT_ONCE]
        rest[first : first + QUERIES_AT_ONCE] = registration.to_rest(part, np.full(len(part), label, dtype=np.uint8))
    return source.index_of(rest)


def _offsets(side: int) -> Int[np.ndarray, "v 3"]:
    """Voxels of a cell, from its first."""
    return np.argwhere(np.ones((side, side, side), dtype=bool))


def _trilinear(side: int) -> Float[np.ndarray, "v 8"]:
    """Weights of a cell's corners at its voxels."""
    share = _offsets(side)[:, None] / side
    return np.where(CUBE, share, 1 - share).prod(axis=2)


def _flat(index: Int[np.ndarray, "*n 3"], shape: "tuple[int, int, int] | list[int]") -> Int[np.ndarray, "*n"]:
    """Positions in the flattened array."""
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), tuple(shape))


# --- carry ------------------------------------------------------------------------------------------------------------

LONGEST_EDGE = 0.05
"""Longest edge of a carried mesh, of half the rest box's longest side: with longer ones a plane could not bend."""

MOST_FACES = 2_000_000

LEAST_SHARE = 1e-3
TINY = 1e-6
"""Distance in scene units below which a point is on the surface."""

STEP = 1e-3
"""Step of the map's Jacobian, of half the rest box's longest side."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Attachment in the rest model.

    Attributes:
        name: of its file.
        content: rest pose, scene units; surfaces with edges short enough to bend.
        shares: of each segment in the motion of each point; rows sum to one. A volume has no points.
        distance: of each point from the nearest segment, 0 inside; scene units.
    """

    name: str
    content: Content
    shares: Float[np.ndarray, "n s"]
    distance: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Carried:
    """Attachment where the object is.

    Attributes:
        name: of its file.
        content: in the registration's frame and unit.
        inside: number of its points that lie inside a segment.
        farthest: largest distance of a point from the nearest segment at rest, in the registration's unit.
    """

    name: str
    content: Content
    inside: int
    farthest: float

    @property
    def count(self) -> int:
        """Number of its points; of a volume, of its voxels."""
        return self.content.values.size if isinstance(self.content, Volume) else len(self.content.points)

    @property
    def told(self) -> str:
        """Phrase on what was carried."""
        outside = self.count - self.inside
        away = f"{outside} of them outside, up to {self.farthest:.4g} away" if outside else "all inside"
        return f"carried {self.name}: {self.count} points, {away}"

    def facts(self) -> dict[str, object]:
        """Facts for a result's summary."""
        return {"file": self.name, "points": self.count, "inside": self.inside, "farthest": self.farthest}


@dataclass(frozen=True, eq=False)
class CarriedVolume(Carried):
    """Volume where the object is.

    Attributes:
        content: the volume.
        inside: number of its voxels that lie inside a segment.
        farthest: width of what is carried around the object, in the registration's unit.
        within: how many of the voxels inside were within the file's voxels at rest.
        interpolation: "linear" or "nearest".
    """

    content: Volume
    within: int
    interpolation: Interpolation

    @property
    def told(self) -> str:
        """Phrase on what was carried."""
        sides = " x ".join(map(str, self.content.values.shape))
        beyond = self.inside - self.within
        where = f", {beyond} of them beyond the file's" if beyond else ""
        apart = f"{self.content.spacing.min():.4g} apart"
        return f"carried {self.name}: {sides} voxels {apart} ({self.interpolation}), {self.inside} inside{where}"

    def facts(self) -> dict[str, object]:
        """Facts for a result's summary."""
        return {
            "file": self.name,
            "voxels": list(self.content.values.shape),
            "spacing": float(self.content.spacing.min()),
            "inside": self.inside,
            "within": self.within,
            "interpolation": self.interpolation,
            "farthest": self.farthest,
        }


def place(attachments: Sequence[Attachment], registrar: Registrar, frame: CarryFrame = "source") -> tuple[Placed, ...]:
    """Attachments in the rest model.

    Args:
        attachments: in the frame and unit that ``frame`` names.
        registrar: of the object.
        frame: "source" is that of the object's own files, "scene" that of its scene.

    Raises ``ValueError`` where the frame of the object's files is not known, and for an attachment that cannot belong
    to the object: most of its points are farther from it than it is long, or none of its voxels is in it.
    """
    T_scene_file = np.eye(4) if frame == "scene" else _source_frame(registrar).T_scene_source
    solids = Solids(registrar.model.rest)
    return tuple(_placed(attachment, T_scene_file, registrar.model, solids) for attachment in attachments)


def carry(placed: Placed, registration: Registration, interpolation: Interpolation = "auto") -> Carried:
    """An attachment where the registered object is: points move along with their segments, poses turn as they do.

    A volume is resampled around the object, with this interpolation (``resampled``).
    """
    content = placed.content
    if isinstance(content, Volume):
        resampled_volume, around = resampled(content, registration, interpolation), MARGIN * registration.model.half
        return CarriedVolume(
            placed.name,
            resampled_volume.volume,
            resampled_volume.inside,
            around * registration.scene_unit,
            resampled_volume.within,
            resampled_volume.interpolation,
        )
    points = moved(registration, content.points, placed.shares)
    rotations = None
    if content.rotations is not None:
        rotations = local_rotations(registration, content.points, placed.shares) @ content.rotations
    farthest = float(placed.distance.max()) * registration.scene_unit
    return Carried(placed.name, content.at(points, rotations), int((placed.distance == 0).sum()), farthest)


def moved(
    registration: Registration, points: Float[np.ndarray, "n 3"], shares: Float[np.ndarray, "n s"]
) -> Float[np.ndarray, "n 3"]:
    """Positions where the registered object is of points at rest that move along with segments by ``shares``."""
    result = np.zeros_like(points)
    for index, share in enumerate(shares.T):
        rows = np.flatnonzero(share > 0)
        if len(rows):
            labels = np.full(len(rows), index + 1, dtype=np.uint8)
            result[rows] += share[rows, None] * registration.to_camera(points[rows], labels)
    return result


def local_rotations(
    registration: Registration, points: Float[np.ndarray, "n 3"], shares: Float[np.ndarray, "n s"]
) -> Float[np.ndarray, "n 3 3"]:
    """Rotation of the surroundings of points at rest: the polar factor of the map's Jacobian there.

    Args:
        registration: of the object.
        points: rest pose, scene units.
        shares: of the segments in their motion.
    """
    step = STEP * registration.model.half
    columns = [
        moved(registration, points + along, shares) - moved(registration, points - along, shares)
        for along in step * np.eye(3)
    ]
    return best_rotations(np.stack(columns, axis=1))  # rows are the Jacobian's columns: its transpose


def _source_frame(registrar: Registrar) -> SourceFrame:
    frame = registrar.model.source_frame
    if frame is None and registrar.given is not None:
        frame = registrar.given.source_frame
    if frame is None:
        raise ValueError(
            f"the weights of {', '.join(registrar.model.rest.names)} do not say how the object's own files lie in the "
            "scene: name the object's scene file with --scene, or carry files in scene units with --carry-frame scene"
        )
    return frame


def _placed(
    attachment: Attachment, T_scene_file: Float[np.ndarray, "4 4"], model: StatisticalModel, solids: Solids
) -> Placed:
    if isinstance(attachment.content, Volume):
        volume = attachment.content
        inside = replace(volume, T_world_index=T_scene_file @ volume.T_world_index)
        check_overlap(attachment.name, inside, T_scene_file, model, solids)
        return Placed(attachment.name, inside, np.zeros((0, solids.count)), np.zeros(0))
    content = _transformed(attachment.content, T_scene_file)
    _check_near(attachment.name, _shares(solids, content.points)[1], 2 * model.half)
    if isinstance(content, Surfaces):
        content = _bendable(content, LONGEST_EDGE * model.half)
    return Placed(attachment.name, content, *_shares(solids, content.points))


def _transformed(content: Placeable, T: Float[np.ndarray, "4 4"]) -> Placeable:
    """Content after a similarity, which turns orientations and does not scale them."""
    turn = T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3]))
    rotations = None if content.rotations is None else turn @ content.rotations
    return content.at(transform_points(T, content.points), rotations)


def _shares(
    solids: Solids, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n s"], Float[np.ndarray, " n"]]:
    """Share of each segment in the motion of points, and their distance from the nearest one, 0 inside.

    Inside a segment the share is its alone. Outside it falls with the fourth power of the distance, so that a surface
    does not tear where another segment comes nearer.
    """
    labels, away = solids.label(points), np.zeros(len(points))
    shares = np.eye(solids.count)[np.maximum(labels, 1) - 1]
    outside = np.flatnonzero(labels == 0)
    if len(outside):
        distance = np.stack([solids.segment_distance(i, points[outside]) for i in range(solids.count)], axis=1)
        away[outside] = distance.min(axis=1)
        closeness = (np.maximum(away[outside, None], TINY) / np.maximum(distance, TINY)) ** 4
        shares[outside] = np.maximum(closeness - LEAST_SHARE, 0.0)
    return shares / shares.sum(axis=1, keepdims=True), away


def _check_near(name: str, distance: Float[np.ndarray, " n"], size: float) -> None:
    far = int((distance > size).sum())
    if far > len(distance) / 2:
        raise ValueError(
            f"{far} of {len(distance)} points of {name} are farther from the object than it is long (in the middle "
            f"{np.median(distance):.4g} scene units, and it has {size:.4g}); it must lie in or near the object: "
            "bring it to the frame and unit of the object's own files, or say --carry-frame scene if it is in scene "
            "units"
        )


def _bendable(content: Surfaces, longest: float) -> Surfaces:
    """Surfaces with edges up to ``longest``."""
    parts = []
    for part in content.mesh.segments:
        vertices, faces = split_long_edges(part.vertices, part.faces, longest, MOST_FACES)
        parts.append(replace(part, vertices=vertices, faces=faces))
    return Surfaces(SegmentedMesh(tuple(parts)))
