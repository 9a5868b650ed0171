"""Carry: what is defined in the rest model comes to where the object is, its inside included.

Attachment -place-> Placed (rest model, scene units) -carry-> Carried (frame and unit of a registration)

Volumes are resampled by ``carry_volumes``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.carry_volumes import MARGIN, Interpolation, check_overlap, resampled
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.procrustes import best_rotations
from mereo.geometry.solids import Solids
from mereo.geometry.subdivision import split_long_edges
from mereo.geometry.transforms import transform_points
from mereo.io.attachments import Attachment, Content, Placeable, Surfaces
from mereo.io.config import CarryFrame
from mereo.io.volume_files import Volume
from mereo.scenes.random_states import with_frame
from mereo.scenes.source_frame import SourceFrame
from mereo.scenes.statistical_model import StatisticalModel

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
    return tuple(_placed(one, T_scene_file, registrar.model, solids) for one in attachments)


def carry(placed: Placed, registration: Registration, interpolation: Interpolation = "auto") -> Carried:
    """An attachment where the registered object is: points move along with their segments, poses turn as they do.

    A volume is resampled around the object, with this interpolation (``carry_volumes.resampled``).
    """
    content = placed.content
    if isinstance(content, Volume):
        found, around = resampled(content, registration, interpolation), MARGIN * registration.model.half
        return CarriedVolume(
            placed.name,
            found.volume,
            found.inside,
            around * registration.scene_unit,
            found.within,
            found.interpolation,
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
    found = with_frame(registrar.model, registrar.trained_scene).source_frame
    if found is None and registrar.given is not None:
        found = registrar.given.source_frame
    if found is None:
        raise ValueError(
            f"the weights of {', '.join(registrar.model.rest.names)} do not say how the object's own files lie in the "
            "scene, as they are from before that was kept: name the object's scene file with --scene, or carry files "
            "in scene units with --carry-frame scene"
        )
    return found


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
