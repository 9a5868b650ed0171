"""What a folder of results keeps for its page: the files that `mereo reconstruct` has written beside the state."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mereo.fitting.registration.state import STATE, read_state
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.glb_scene import GlbScene, read_glb
from mereo.io.writers.formats import WRITERS
from mereo.models.weights_place import is_weights
from mereo.visualization.trust import Level
from mereo.visualization.units import UNKNOWN, Unit
from mereo.visualization.viewer.panels import DepthPicture
from mereo.visualization.written_report import REPORT, WrittenReport, read_report

NEAR = 1e-4
"""Distance, as a share of the object's longest side, within which a vertex of a file is one of the model."""


def is_kept(path: Path) -> bool:
    """Whether a path is a folder of results that has surfaces, but no state of a model that weights carry."""
    if not (path.is_dir() and (path / WRITERS["glb"].file).is_file()):
        return False
    return not (path / STATE).is_file() or _is_without_weights(path)


def _is_without_weights(path: Path) -> bool:
    """Whether a result was made without weights; those of a program that have no name are the scene's."""
    state = read_state(path)
    return state.weights == "" and not is_weights(state.scene)


@dataclass(frozen=True, eq=False)
class KeptResult:
    """Files of a folder of results, as far as it has them.

    Attributes:
        report: what its page shows.
        scene: its surfaces, in the input's frame and unit.
    """

    report: WrittenReport | None = None
    scene: GlbScene | None = None

    @classmethod
    def of(cls, path: Path) -> "KeptResult":
        """What is kept in a folder of results, or beside its state file; nothing for a state that lies elsewhere.

        Raises ``ValueError`` for a damaged GLB file.
        """
        folder = path if path.is_dir() else path.parent
        if not path.is_dir() and path.name != STATE:
            return cls()
        surfaces = folder / WRITERS["glb"].file
        return cls(read_report(folder / REPORT), read_glb(surfaces) if surfaces.is_file() else None)

    @property
    def title(self) -> str | None:
        """Name of what was seen."""
        return None if self.report is None else self.report.title

    @property
    def level(self) -> Level | None:
        """Level of the verdict."""
        return None if self.report is None else self.report.level

    @property
    def verdict(self) -> str:
        """Whether to trust the answer, why, and what to do; "" where the folder does not say it."""
        return "" if self.report is None else self.report.verdict

    @property
    def cloud(self) -> PointCloud | None:
        """Observed points, as many as the report shows."""
        return None if self.report is None else self.report.cloud

    @property
    def count(self) -> int:
        """Number of observed points."""
        return 0 if self.report is None else self.report.count

    @property
    def depth(self) -> DepthPicture | None:
        """Depth image."""
        if self.report is None or self.report.depth is None:
            return None
        return DepthPicture(self.report.depth, self.report.ends)

    @property
    def unit(self) -> Unit | None:
        """Unit of all lengths; None where the folder does not say whether it is known."""
        if self.report is None:
            return None
        return Unit(self.scene.unit_m) if self.report.unit_known and self.scene is not None else UNKNOWN

    def radii(self, mesh: SegmentedMesh) -> Radii | None:
        """Radii of the vertices of a mesh in the input's frame; None where the files have none of this mesh."""
        scene = self.scene
        if scene is None or scene.radii is None or scene.mesh.names != mesh.names:
            return None
        values = []
        longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
        for part, known, radii in zip(mesh.segments, scene.mesh.segments, scene.radii.vertices, strict=True):
            away, nearest = cKDTree(known.vertices).query(part.vertices)
            if away.max() > NEAR * longest:
                return None
            values.append(radii[nearest])
        counts = tuple(len(value) for value in values)
        labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
        points = np.concatenate([part.vertices for part in mesh.segments])
        return Radii(points, labels, np.concatenate(values), counts, scene.radii.calibrated)
