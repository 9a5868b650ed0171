"""Ground truth on a grid: what a reconstruction is scored against."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid

BOX_MARGIN = 0.25
"""Share of its size by which a segment's box is enlarged on each side: by 50 % in all, as in the paper."""


@dataclass(frozen=True, eq=False)
class TruthGrid:
    """Ground truth of an evaluation: true labels on a grid, and which of its cells count (paper, appendix B).

    Attributes:
        grid: true labels at the centres of the cells into which the joint box of all segments is divided.
        kept: which of them count: those in the enlarged box of at least one segment.
    """

    grid: LabelGrid
    kept: Bool[np.ndarray, "x y z"]

    def scaled(self, factor: float) -> "TruthGrid":
        """The same with all lengths ``factor`` times as long."""
        grid = replace(self.grid, origin=factor * self.grid.origin, spacing=factor * self.grid.spacing)
        return TruthGrid(grid, self.kept)


def truth_grid(mesh: SegmentedMesh, cells: int = 100) -> TruthGrid:
    """Ground truth at the centres of ``cells`` ** 3 cells, into which the joint box of all segments is divided."""
    low, high = mesh.bounds
    spacing = (high - low) / cells
    origin = low + spacing / 2
    x, y, z = (origin[axis] + np.arange(cells) * spacing[axis] for axis in range(3))
    kept = np.zeros((cells, cells, cells), dtype=bool)
    for segment in mesh.segments:
        first, last = segment.bounds
        margin = BOX_MARGIN * (last - first)
        inside = [(c >= a) & (c <= b) for c, a, b in zip((x, y, z), first - margin, last + margin, strict=True)]
        kept[np.ix_(*inside)] = True
    return TruthGrid(LabelGrid(label_grid(mesh, x, y, z), origin, spacing, mesh.names), kept)
