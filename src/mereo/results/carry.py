"""Carry what is defined in the rest model to where the object is, its inside included.

Attachment -place-> Placed (rest model, scene units) -carry-> Carried (frame and unit of a registration)
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy import ndarray
from numpy.linalg import det, inv, norm
from scipy.ndimage import map_coordinates

from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.labels import GridLabels, VoxelMask
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids, label_grid
from mereo.geometry.subdivision import split_long_edges
from mereo.geometry.transforms import (
    Flags,
    Indices,
    Matrices,
    PointArray,
    Points,
    Subset,
    Transform,
    Values,
    Vector,
    best_rotations,
    box_of,
    transform_points,
)
from mereo.io.attachments import Attachment, Content, Surfaces, turned_attachment
from mereo.io.bounds import check_value
from mereo.io.config import CarryFrame
from mereo.io.volume_files import Volume, is_labels
from mereo.scenes.statistical_model import StatisticalModel

SegmentShares = Float[ndarray, "n s"]
"""Share of each segment in the motion of each point."""

Interpolation = Literal["linear", "nearest"]
"""Linear for intensities, nearest for labels (``is_labels``)."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Attachment in the rest model.

    Attributes:
        name: of its file.
        content: rest pose, scene units; surfaces with edges short enough to bend.
        shares: of each segment in the motion of each point; rows sum to one. A volume has no points.
        distance: of each point from the nearest segment, 0 inside; scene units.
        note: on the space that it was turned from, for what is printed.
    """

    name: str
    content: Content
    shares: SegmentShares
    distance: Values
    note: str = ""


@dataclass(frozen=True, eq=False)
class Carried:
    """Attachment where the object is.

    Attributes:
        name: of its file.
        content: in the registration's frame and unit.
        inside: number of its points, or of a volume's voxels, that lie inside a segment.
        farthest: largest distance of a point from the nearest segment at rest; of a volume, width of what is carried
            around the object; in the registration's unit.
    """

    name: str
    content: Content
    inside: int
    farthest: float
    note: str = ""

    @property
    def description(self) -> str:
        """Phrase on what was carried."""
        assert not isinstance(self.content, Volume)
        count = len(self.content.points)
        away = f"{count - self.inside} of them outside, up to {self.farthest:.4g} away"
        return f"carried {self.name}{self.note}: {count} points, {away if count > self.inside else 'all inside'}"

    def facts(self) -> dict[str, object]:
        """Facts for a result's summary."""
        assert not isinstance(self.content, Volume)
        points = len(self.content.points)
        return {"file": self.name, "points": points, "inside": self.inside, "farthest": self.farthest}


@dataclass(frozen=True, eq=False)
class CarriedVolume(Carried):
    """Volume where the object is.

    Attributes:
        content: the volume.
        within: how many of the voxels inside were within the file's voxels at rest; the others have the background.
    """

    content: Volume
    within: int = 0
    interpolation: Interpolation = "linear"

    @property
    def description(self) -> str:
        """Phrase on what was carried."""
        sides = " x ".join(map(str, self.content.values.shape))
        beyond = self.inside - self.within
        where = f", {beyond} of them beyond the file's" if beyond else ""
        apart = f"{self.content.spacing.min():.4g} apart"
        voxels = f"{sides} voxels {apart} ({self.interpolation})"
        return f"carried {self.name}{self.note}: {voxels}, {self.inside} inside{where}"

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
    """Bring attachments into the rest model.

    Args:
        attachments: in the frame and unit that ``frame`` names.
        registrar: of the object.
        frame: "source" is that of the object's own files, "scene" that of its scene; "RAS" and "LPS" state the space of
            the object's own files, where these do not name it.

    What names the other space is turned. Raises ``ValueError`` where the frame of the object's files is not known, and
    for an attachment that cannot belong to the object: most of its points are farther from it than it is long, none of
    its voxels is in it, or it would fit far better in the other space.
    """
    check_value("files", frame, CarryFrame, "source")
    T_scene_file = np.eye(4)
    if frame != "scene":
        source = registrar.model.source_frame
        if source is None and registrar.given is not None:
            source = registrar.given.source_frame
        if source is None:
            raise ValueError(
                f"the weights of {', '.join(registrar.model.rest.names)} do not say how the object's own files lie in "
                "the scene: name the object's scene file with --scene, or carry files in scene units with "
                "--carry-frame scene"
            )
        T_scene_file = source.T_scene_source
        inside = transform_points(inv(T_scene_file), registrar.model.nodes)
        attachments = [turned_attachment(each, frame, source.space, inside) for each in attachments]
    solids = Solids(registrar.model.rest)
    return tuple(_placed(attachment, T_scene_file, registrar.model, solids) for attachment in attachments)


def _placed(attachment: Attachment, T_scene_file: Transform, model: StatisticalModel, solids: Solids) -> Placed:
    name = attachment.name
    content = attachment.content
    size = 2 * model.half
    if isinstance(content, Volume):
        volume = replace(content, T_world_index=T_scene_file @ content.T_world_index)
        check_overlap(name, volume, T_scene_file, model, solids)
        return Placed(name, volume, np.zeros((0, solids.count)), np.zeros(0), attachment.note)
    turn = T_scene_file[:3, :3] / np.cbrt(det(T_scene_file[:3, :3]))  # orientations are not scaled
    rotations = None if content.rotations is None else turn @ content.rotations
    content = content.at(transform_points(T_scene_file, content.points), rotations)
    shares, distance = _shares(solids, content.points)
    far = int((distance > size).sum())
    if far > len(distance) / 2:
        raise ValueError(
            f"{name}: {far} of {len(distance)} points are farther from the object than it is long (the median one "
            f"{np.median(distance):.4g} scene units, its length is {size:.4g}); they must lie in or near the object: "
            "bring them to the frame and unit of the object's own files, or say --carry-frame scene if they are in "
            "scene units"
        )
    if isinstance(content, Surfaces):  # with longer edges a plane could not bend
        parts = content.mesh.segments
        short = (split_long_edges(part.vertices, part.faces, 0.05 * model.half, 2_000_000) for part in parts)
        parts = tuple(replace(part, vertices=v, faces=f) for part, (v, f) in zip(parts, short, strict=True))
        content = Surfaces(SegmentedMesh(parts))
        shares, distance = _shares(solids, content.points)
    return Placed(name, content, shares, distance, attachment.note)


def check_overlap(name: str, volume: Volume, T_scene_file: Transform, model: StatisticalModel, solids: Solids) -> None:
    """Raise ``ValueError`` for a volume, in scene units, without any voxel in the object."""
    if volume.holds(volume.index_of(model.rest_points)).any():
        return
    ticks = [np.linspace(-0.5, n - 0.5, 24) for n in volume.values.shape]
    sample = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    if solids.label(transform_points(volume.T_world_index, sample)).any():
        return
    boxes = []
    for bounds in (volume.bounds, model.rest.bounds):
        corners = transform_points(inv(T_scene_file), np.array(list(product(*bounds.T))))
        boxes.append(" to ".join(str(corner.round(2).tolist()) for corner in box_of(corners)))
    raise ValueError(
        f"{name} holds nothing of the object: in RAS its voxels lie from {boxes[0]}, and the object's own files "
        f"from {boxes[1]}; both must have one frame and unit: export the volume in that of the object's own "
        "files, or say --carry-frame scene if it is in scene units"
    )


def _shares(solids: Solids, points: Points) -> tuple[SegmentShares, Values]:
    """Share of each segment in the motion of points, and their distance from the nearest segment, 0 inside.

    Outside the share falls with the fourth power of the distance, so that a surface does not tear where another
    segment comes nearer.
    """
    labels = solids.label(points)
    away = np.zeros(len(points))
    shares = np.eye(solids.count)[np.maximum(labels, 1) - 1]
    outside = np.flatnonzero(labels == 0)
    if len(outside):
        distance = np.stack([solids.segment_distance(i, points[outside]) for i in range(solids.count)], axis=1)
        away[outside] = distance.min(axis=1)
        closeness = (np.maximum(away[outside, None], 1e-6) / np.maximum(distance, 1e-6)) ** 4
        shares[outside] = np.maximum(closeness - 1e-3, 0.0)
    return shares / shares.sum(axis=1, keepdims=True), away


def carry(placed: Placed, registration: Registration) -> Carried:
    """Carry an attachment to where the registered object is: points move along with their segments, poses turn so too.

    A volume is resampled around the object (``resampled``).
    """
    content = placed.content
    if isinstance(content, Volume):
        return replace(resampled(content, registration, placed.name), note=placed.note)
    points = moved(registration, content.points, placed.shares)
    rotations = None
    if content.rotations is not None:
        rotations = local_rotations(registration, content.points, placed.shares) @ content.rotations
    farthest = float(placed.distance.max()) * registration.scene_unit
    inside = int((placed.distance == 0).sum())
    return Carried(placed.name, content.at(points, rotations), inside, farthest, placed.note)


def moved(registration: Registration, points: Points, shares: SegmentShares) -> Points:
    """Move points at rest, which go along with segments by ``shares``, to where the registered object is."""
    result = np.zeros_like(points)
    for index, share in enumerate(shares.T):
        rows = np.flatnonzero(share > 0)
        if len(rows):
            labels = np.full(len(rows), index + 1, np.uint8)
            result[rows] += share[rows, None] * registration.to_camera(points[rows], labels)
    return result


def local_rotations(registration: Registration, points: Points, shares: SegmentShares) -> Matrices:
    """Return the rotation of the surroundings of points at rest: the polar factor of the map's Jacobian."""
    step = 1e-3 * registration.model.half
    columns = [
        moved(registration, points + along, shares) - moved(registration, points - along, shares)
        for along in step * np.eye(3)
    ]
    return best_rotations(np.stack(columns, axis=1))  # rows are the Jacobian's columns: its transpose


# --- volumes ----------------------------------------------------------------------------------------------------------

# output voxel -to_rest-> rest model, scene units -T_index_scene-> voxel index of the source -interpolation-> value
#
# ``Registration.to_rest`` takes a minute for a million points, so it is called at the corners of cells of 4 voxels,
# then of 2, and linearly interpolated in those at whose centre that is right; in all others it is called everywhere.

MARGIN = 0.05
"""Width of what is carried around the object, of half the rest box's longest side."""

CELLS = (4, 2)
"""Voxels along the sides of the cells in which rest positions are interpolated, one after the other."""

TOLERANCE = 0.04
"""Voxels of the source by which that may be off at a cell's centre. Away from it, where the nearest material points
change, it is up to twice as much: inside the object less than 0.1."""

QUERIES_AT_ONCE = 2000
"""Points in one call of ``to_rest``: of more its weights leave the cache, and it takes twice as long."""

CELLS_AT_ONCE, POINTS_AT_ONCE = 1024, 500_000

CUBE = np.indices((2, 2, 2)).reshape(3, 8).T


def resampled(source: Volume, registration: Registration, name: str = "", most: int = 16_000_000) -> CarriedVolume:
    """Resample a volume that was defined in the rest model on a grid around the registered object.

    Voxels inside the object have the source's value where they were at rest, and so have those around it, up to
    ``MARGIN``, as if they moved along with the nearest segment. All others have the source's least value, in its own
    meaning (after its slope and intercept).

    Args:
        source: its ``T_world_index`` leads to scene units of the rest model.
        registration: of the object.
        name: of the volume's file.
        most: voxels of the grid; its spacing is the source's finest, widened where the grid would have more.
    """
    interpolation: Interpolation = "nearest" if is_labels(source) else "linear"
    fill = _Fill.around(source, registration, interpolation, most)
    owner, inside = fill.owners()
    within = sum(fill.segment(label, owner == label, inside) for label in range(1, fill.registration.solids.count + 1))
    transform = np.diag([*[fill.spacing] * 3, 1.0])
    transform[:3, 3] = fill.origin
    volume = replace(source, values=fill.values, T_world_index=transform)
    return CarriedVolume(name, volume, int(inside.sum()), fill.margin, within=within, interpolation=interpolation)


@dataclass(frozen=True, eq=False)
class _Fill:
    """Axis-aligned grid around a registered object, which is filled with the values of a source.

    Attributes:
        source, registration, interpolation: what is resampled, where the object is, and how.
        margin: what is filled around the object.
        origin, spacing: centre of voxel [0, 0, 0], and distance between centres.
        background: value outside the source's voxels.
        values: of the voxels, filled in place; the sides are multiples of the largest cell's.
    """

    source: Volume
    registration: Registration
    interpolation: Interpolation
    margin: float
    origin: Vector
    spacing: float
    background: float | int
    values: Shaped[ndarray, "x y z"]

    @classmethod
    def around(cls, source: Volume, registration: Registration, interpolation: Interpolation, most: int) -> "_Fill":
        """Grid over the object and the margin, with at most so many voxels, all of them background."""
        margin = MARGIN * registration.model.half * registration.scene_unit
        spacing = float(source.spacing.min()) * registration.scene_unit
        bounds = registration.mesh.bounds
        size = bounds[1] - bounds[0] + 2 * margin
        cell = CELLS[0]
        while True:
            cells = np.maximum(np.ceil(size / (cell * spacing)).astype(np.int64), 1)
            if (count := int(cells.prod()) * cell**3) <= max(most, cell**3):
                break
            spacing *= max((count / most) ** (1 / 3), 1.01)
        origin = bounds.mean(axis=0) - (cell * cells - 1) * spacing / 2
        background = (source.values.max() if source.slope < 0 else source.values.min()).item()
        values = np.full(cell * cells, background, source.values.dtype)
        return cls(source, registration, interpolation, margin, origin, spacing, background, values)

    def at(self, index: Shaped[ndarray, "*n 3"]) -> PointArray:
        """Positions of voxel indices, which may have fractions."""
        return self.origin + self.spacing * index

    def at_rows(self, rows: Indices) -> Points:
        """Positions of voxels by their rows in the flattened grid."""
        return self.at(np.stack(np.unravel_index(rows, self.values.shape), axis=1))

    def owners(self) -> tuple[GridLabels, VoxelMask]:
        """Label of the segment that each voxel moves along with, 0 beyond the margin, and whether it is inside it."""
        shape, solids = self.values.shape, self.registration.solids
        x, y, z = (self.origin[axis] + self.spacing * np.arange(shape[axis]) for axis in range(3))
        owner = label_grid(solids.mesh, x, y, z)
        inside = owner > 0
        side = CELLS[0]
        cells = np.argwhere(np.ones([n // side for n in shape], bool))
        reach = self.margin + np.sqrt(3) / 2 * side * self.spacing
        near = cells[solids.nearest(self.at(side * cells + (side - 1) / 2)).distance <= reach]
        rows = _flat(side * near[:, None] + _offsets(side), shape).ravel()
        rows = rows[owner.ravel()[rows] == 0]
        for part in _parts(len(rows), POINTS_AT_ONCE):
            nearest = solids.nearest(self.at_rows(rows[part]))
            owner.reshape(-1)[rows[part]] = np.where(nearest.distance <= self.margin, nearest.owner + 1, 0)
        return owner, inside

    def segment(self, label: int, todo: VoxelMask, inside: VoxelMask) -> int:
        """Fill one segment's voxels, ``todo``; returns how many of them inside the object were within the source."""
        open_ = todo.reshape(-1)
        inside_ = inside.reshape(-1)
        held = 0
        shape = self.values.shape
        for side in CELLS:
            cells = np.argwhere(todo.reshape([part for n in shape for part in (n // side, side)]).any(axis=(1, 3, 5)))
            corners, right = self._corners(cells, side, label)
            share = _offsets(side)[:, None] / side
            weights = np.where(CUBE, share, 1 - share).prod(axis=2)  # trilinear
            cells, corners = cells[right], corners[right]
            for part in _parts(len(cells), CELLS_AT_ONCE):
                rows = _flat(side * cells[part, None] + _offsets(side), shape)
                wanted = open_[rows]
                held += int(inside_[self._put(rows[wanted], (weights @ corners[part])[wanted])].sum())
                open_[rows] = False
        left = np.flatnonzero(open_)
        for part in _parts(len(left), POINTS_AT_ONCE):
            index = self._source_index(self.at_rows(left[part]), label)
            held += int(inside_[self._put(left[part], index)].sum())
        return held

    def _put(self, rows: Indices, index: Points) -> Subset:
        """Fill voxels with the source's values at indices with fractions; returns those that it holds."""
        source = self.source.values
        held = self.source.holds(index)
        if self.interpolation == "nearest":
            nearest = np.clip(np.rint(index).astype(np.int64), 0, np.array(source.shape) - 1)
            sampled = source[tuple(nearest.T)]
        else:
            smooth = map_coordinates(source, index.T, order=1, mode="nearest", output=float)
            sampled = (np.rint(smooth) if source.dtype.kind in "iu" else smooth).astype(source.dtype)
        sampled[~held] = self.background
        self.values.reshape(-1)[rows] = sampled
        return rows[held]

    def _corners(self, cells: Int[ndarray, "n 3"], side: int, label: int) -> tuple[Float[ndarray, "n 8 3"], Flags]:
        """Indices in the source of cells' corners, and whether they may be interpolated, by the cells' centres."""
        shape = [n // side + 1 for n in self.values.shape]
        nodes, row = np.unique(_flat(cells[:, None] + CUBE, shape), return_inverse=True)
        at_nodes = side * np.stack(np.unravel_index(nodes, shape), axis=1)
        corners = self._source_index(self.at(at_nodes), label)[row.reshape(-1, 8)]
        centers = self._source_index(self.at(side * (cells + 0.5)), label)
        return corners, norm(corners.mean(axis=1) - centers, axis=1) <= TOLERANCE

    def _source_index(self, points: Points, label: int) -> Points:
        """Voxel indices, with fractions, of where points that move along with a segment were at rest."""
        rest = np.empty_like(points)
        labels = np.full(len(points), label, np.uint8)
        for part in _parts(len(points), QUERIES_AT_ONCE):
            rest[part] = self.registration.to_rest(points[part], labels[part])
        return self.source.index_of(rest)


def _parts(count: int, most: int) -> Iterator[slice]:
    return (slice(first, first + most) for first in range(0, count, most))


def _offsets(side: int) -> Int[ndarray, "v 3"]:
    """Voxels of a cell, from its first."""
    return np.argwhere(np.ones((side, side, side), bool))


def _flat(index: Int[ndarray, "*n 3"], shape: Sequence[int]) -> Int[ndarray, "*n"]:
    """Rows in the flattened array."""
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), tuple(shape))
