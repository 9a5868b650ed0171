"""Carry what is defined in the object's own files to where a frame shows the object, its inside included.

points, mesh or file -carry_to-> the same in the frame's axes and unit
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.carry import Carried, carry, place
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.atomic_files import atomic_file
from mereo.io.attachments import Attachment, Content, Positions, Surfaces, read_attachments, write_attachment
from mereo.io.config import CarryFrame
from mereo.io.point_arrays import points_of
from mereo.io.sensor_frame import SensorFrame
from mereo.io.writers.glb import viewer_rotation
from mereo.io.writers.medical import MM_PER_M


@dataclass(frozen=True, eq=False, repr=False)
class CarriedFile:
    """Content of a file where the object is.

    Attributes:
        name: of the file, without its folder.
        content: surfaces, points, poses or a volume, in the frame's axes and unit.
        inside: number of its points, or voxels, that lie inside a segment.
        farthest: largest distance of a point from the nearest segment at rest, in the frame's unit.
        frame: in which it is.
    """

    name: str
    content: Content
    inside: int
    farthest: float
    frame: SensorFrame

    def __repr__(self) -> str:
        return f"CarriedFile({self.name!r}, {type(self.content).__name__}, {self.inside} inside)"

    def save(self, path: str | Path | None = None, *, millimetres: bool = False, overwrite: bool = False) -> Path:
        """Write it in its file's format, by default under its own name in this folder; returns the path.

        Args:
            path: the suffix is that of ``name``.
            millimetres: write files that have no unit in millimetres, not in the frame's unit.
            overwrite: replace a file.

        Raises ``FileExistsError`` for what exists, unless ``overwrite``, and ``ValueError`` for another suffix.
        """
        path = Path(self.name if path is None else path)
        if path.suffixes[-1:] != Path(self.name).suffixes[-1:]:
            raise ValueError(f"{path} has another suffix than {self.name}, in whose format it is written: use that one")
        factor = MM_PER_M * self.frame.metres if millimetres else 1.0
        with atomic_file(path, force=overwrite) as partial:
            write_attachment(partial, self.content, factor, viewer_rotation(self.frame.axes), self.frame.metres)
        return path


def carry_to(answer: Answer, what: Any, files: CarryFrame = "source") -> Any:
    """Carry points, a mesh or a file to where an answer has the object.

    Args:
        answer: one that is the registered model.
        what: points (whatever ``load_frame`` takes of points), which come back as an array [n, 3]; a mesh of trimesh,
            ``Segment`` or ``SegmentedMesh``, which comes back as its kind, with edges short enough to bend; or the path
            of a file as of ``--carry``, a volume included, which comes back as a ``CarriedFile``.
        files: frame and unit of what is carried: "source" is that of the object's own files, "scene" that of its scene.

    Raises ``ValueError`` where the answer is the network's, where the frame of the object's files is not known, and for
    what lies too far from the object to belong to it.
    """
    if isinstance(what, str | Path):
        carried = _carried(answer, read_attachments([what])[0], files)
        return CarriedFile(carried.name, carried.content, carried.inside, carried.farthest, answer.seen.frame)
    if isinstance(what, SegmentedMesh):
        return _moved(answer, what, files)
    if isinstance(what, Segment):
        return _moved(answer, SegmentedMesh((what,)), files).segments[0]
    if hasattr(what, "vertices") and hasattr(what, "faces"):
        vertices, faces = np.asarray(what.vertices, dtype=np.float64), np.asarray(what.faces, dtype=np.int64)
        part = _moved(answer, SegmentedMesh((Segment("mesh", PALETTE[0], vertices, faces, solid=False),)), files)
        return type(what)(part.segments[0].vertices, part.segments[0].faces, process=False)
    return _points(answer, what, files)


def _points(answer: Answer, what: Any, files: CarryFrame) -> Float[np.ndarray, "n 3"]:
    cloud, _ = points_of(what)
    if not isinstance(cloud, PointCloud):
        raise ValueError("a depth image is no part of an object's files: carry points, a mesh or a file")
    return _carried(answer, Attachment("the points", Positions(cloud.points)), files).content.points  # type: ignore[union-attr]


def _moved(answer: Answer, mesh: SegmentedMesh, files: CarryFrame) -> SegmentedMesh:
    content = _carried(answer, Attachment("the mesh", Surfaces(mesh)), files).content
    assert isinstance(content, Surfaces)
    return content.mesh


def _carried(answer: Answer, attachment: Attachment, files: CarryFrame) -> Carried:
    registered = registration_of(answer)
    assert answer.registrar is not None
    (placed,) = place([attachment], answer.registrar, files)
    return carry(placed, registered)


def registration_of(answer: Answer) -> Registration:
    """Registration along which things are carried, in the frame's axes; ``ValueError`` where the network answers."""
    if answer.registered is None:
        raise ValueError(
            "the network's answer is kept, but --carry needs a registration, along which things move: leave out of the "
            "cloud what is not the object, or take the registered model in any case with --method modes"
        )
    return answer.registered
