"""Segments in numbers: volume, place, and how sure the model is; and the segment of each observed point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage
from scipy.special import expit, logsumexp, softmax

from mereo.geometry.downsampling import random_subset
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import Color, Segment
from mereo.models.calibration import Calibration
from mereo.models.trained import EncodedCloud, Trained
from mereo.reconstruction.isosurfaces import Extraction

CONFIDENCE_VOXELS = 2000
"""Most voxels of a segment over which its confidence is a mean."""


@dataclass(frozen=True, eq=False)
class FoundSegment:
    """Segment in numbers, in the input's frame and units.

    Attributes:
        name, label: of the segment.
        volume: inside its surface, less what is nested in it; 0 where it was not found.
        centroid: mean of its voxels, NaN where it was not found.
        box: lower and upper corner of its surface, NaN where it was not found.
        confidence: mean probability that the network gives it over its voxels; NaN where it was not found, and
            without a network.
        voxels: how many of the label grid it has.
        components: connected groups of voxels (over faces); more than one may be a fleck, and nothing is removed.
    """

    name: str
    label: int
    volume: float
    centroid: Float[np.ndarray, "3"]
    box: Float[np.ndarray, "2 3"]
    confidence: float
    voxels: int
    components: int

    def __repr__(self) -> str:
        sure = "" if np.isnan(self.confidence) else f", confidence {self.confidence:.2f}"
        found = f"volume {self.volume:.3g}{sure}" if self.voxels else "not found"
        return f"FoundSegment({self.name!r}, {found})"


def segment_points(
    logits: Float[np.ndarray, "n c"],
    points: Float[np.ndarray, "n 3"],
    names: tuple[str, ...],
    colors: tuple[Color, ...],
    calibration: Calibration | None = None,
    labels: UInt8[np.ndarray, " n"] | None = None,
) -> SegmentedCloud:
    """Segment of each point from the model's logits there, and the model's probability of it.

    Args:
        logits: of empty space and each segment.
        points: in the input's frame and unit.
        names: of the segments.
        colors: of the segments.
        calibration: of the weights, by which probabilities are made of logits; labels do not depend on it.
        labels: of the points, 1 or more, where another than the network says them.
    """
    labels = (logits[:, 1:].argmax(axis=1) + 1).astype(np.uint8) if labels is None else labels
    scaled = logits if calibration is None else _scaled(calibration, logits)
    parts = scaled[:, 1:].astype(np.float64)
    return SegmentedCloud(
        points=points,
        labels=labels,
        confidence=np.take_along_axis(softmax(parts, axis=1), labels[:, None].astype(np.int64) - 1, axis=1)[:, 0],
        occupancy=expit(logsumexp(parts, axis=1) - scaled[:, 0]),
        names=names,
        colors=colors,
    )


def _scaled(calibration: Calibration, logits: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
    from mereo.models.model import scaled_array  # it needs torch, which whoever has logits has

    return scaled_array(calibration.scaling, logits)


def measure(found: Extraction, model: Trained | None, code: EncodedCloud | None) -> tuple[FoundSegment, ...]:
    """Every segment of an extraction in numbers; ``code`` is what ``model`` made of the cloud, None without one."""
    owned = zip(found.surfaces.segments, found.surfaces.owned_volumes, strict=True)
    return tuple(
        _measure(found.grid, label, segment, float(volume), model, code)
        for label, (segment, volume) in enumerate(owned, start=1)
    )


def _measure(
    grid: LabelGrid, label: int, segment: Segment, volume: float, model: Trained | None, code: EncodedCloud | None
) -> FoundSegment:
    voxels = np.argwhere(grid.labels == label)
    if len(voxels) == 0:
        nothing = np.full((2, 3), np.nan)
        return FoundSegment(segment.name, label, 0.0, nothing[0], nothing, float("nan"), 0, 0)
    confidence = float("nan")
    if model is not None and code is not None:
        chosen = random_subset(voxels, CONFIDENCE_VOXELS)
        confidence = float(model.query(code, grid.positions(chosen)).probability[:, label].mean())
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    part = grid.labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    return FoundSegment(
        name=segment.name,
        label=label,
        volume=volume,
        centroid=grid.positions(voxels).mean(axis=0),
        box=segment.bounds,
        confidence=confidence,
        voxels=len(voxels),
        components=int(ndimage.label(part == label)[1]),
    )
