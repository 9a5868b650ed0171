"""The inverse path: from what a camera saw of an object to all its segments, hidden side included.

    Reading -normalize, encode_frame-> EncodedFrame -query-> Field -locate, extract-> SegmentedMesh
                                            '---------------- ask for more ----------------> Answer

This undoes what ``mereo.synthesis.examples.synthesize`` does. Everything that comes out is in the input's
frame and units.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.special import expit, logsumexp, softmax

from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import CloudAxes, Names
from mereo.geometry.downsampling import random_subset
from mereo.geometry.labels import LabelGrid, SegmentedCloud, VoxelMask, part_of_grid
from mereo.geometry.mesh import PALETTE, SegmentColors, SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import Corners, Labels, Points, Rows, Transform, Vector, inverse_rigid, transform_points
from mereo.models.calibration import Calibration
from mereo.models.trained import EncodedCloud, Trained, checked_points
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.isosurfaces import Extraction, extract_whole, locate

SEARCH_BOX = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 2.5]])
"""Box in which segments are looked for first, normalized: the visible part fills [-1, 1], the hidden one is behind."""

CONFIDENCE_VOXELS = 2000
"""Most voxels of a segment over which its confidence is a mean."""

Seconds = dict[str, float]
"""Seconds of each stage."""


@dataclass(frozen=True, eq=False)
class SegmentFacts:
    """Segment in numbers, in the input's frame and units.

    Attributes:
        name, label: of the segment.
        volume: inside its surface, less what is nested in it; 0 where it was not found.
        centroid: mean of its voxels, NaN where it was not found.
        box: lower and upper corner of its surface, NaN where it was not found.
        confidence: mean probability that the network gives it over its voxels; NaN where it was not found, and
            without a network.
        voxels: how many of the label grid it has.
        components: how many parts it is in, without specks (``count_parts``), of which nothing is removed.
    """

    name: str
    label: int
    volume: float
    centroid: Vector
    box: Corners
    confidence: float
    voxels: int
    components: int

    def __repr__(self) -> str:
        return described(self, self.voxels > 0)


def described(part: Any, is_present: bool) -> str:
    """One line for a segment in figures: its name, and its volume and confidence where it was found."""
    sure = "" if np.isnan(part.confidence) else f", confidence {part.confidence:.2f}"
    figures = f"volume {part.volume:.3g}{sure}" if is_present else "not found"
    return f"{type(part).__name__}({part.name!r}, {figures})"


def along_axes(surfaces: SegmentedMesh, before: LabelGrid) -> LabelGrid:
    """Label grid of surfaces along the axes of their frame, as fine as that ``before``."""
    spacing, (low, high) = before.spacing, surfaces.bounds
    counts = np.ceil((high - low) / spacing).astype(int) + 3  # with one empty voxel around
    corner = (low + high - (counts - 1) * spacing) / 2
    grid = replace(before, labels=np.zeros(counts, np.uint8), origin=corner)
    return replace(grid, labels=label_grid(surfaces, *grid.axes()))


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Object with all its segments, in the input's frame and units.

    Attributes:
        surfaces: every segment of the model as a closed mesh; without faces where it was not found. Which lie inside
            another is declared as in the model's scene.
        labels: the label grid.
        segments: each segment in numbers, in the same order.
        timings_s: seconds of each stage.
        evaluated: points at which the network was evaluated for surfaces.
        clipped: whether a segment still reached the largest box and was closed there.
        code: what the network made of the cloud; ask it for more with ``Model.query``, in the camera frame. None
            without a network.
        T_camera_input: from the input's frame to the camera frame.
        reading: which of the input's points are taken for the object's; the others were dropped as strays.
        observed: the segment of each of these points, where it was asked for.
        calibrated: whether confidences and probabilities are calibrated (``Model.calibrates``).
    """

    surfaces: SegmentedMesh
    labels: LabelGrid
    segments: tuple[SegmentFacts, ...]
    timings_s: Seconds
    evaluated: int
    clipped: bool
    code: EncodedCloud | None
    T_camera_input: Transform
    reading: Reading
    observed: SegmentedCloud | None = None
    calibrated: bool = False

    def transformed(self, T_new_input: Transform) -> "Reconstruction":
        """The same in another frame, by a rigid transform; its label grid lies along the new axes."""
        surfaces = self.surfaces.transformed(T_new_input)
        grid = along_axes(surfaces, self.labels)
        segments = tuple(
            replace(
                segment,
                centroid=transform_points(T_new_input, segment.centroid),
                box=mesh.bounds if len(mesh.faces) else segment.box,
                voxels=int((grid.labels == segment.label).sum()),
            )
            for segment, mesh in zip(self.segments, surfaces.segments, strict=True)
        )
        seen = self.observed
        return replace(
            self,
            surfaces=surfaces,
            labels=grid,
            segments=segments,
            T_camera_input=self.T_camera_input @ inverse_rigid(T_new_input),
            reading=replace(self.reading, whole=self.reading.whole.transformed(T_new_input)),
            observed=None if seen is None else replace(seen, points=transform_points(T_new_input, seen.points)),
        )

    @property
    def seconds(self) -> float:
        """Seconds of all stages together."""
        return sum(self.timings_s.values())

    def __repr__(self) -> str:
        present = sum(segment.voxels > 0 for segment in self.segments)
        segments = f"{counted(len(self.segments), 'segment')} found: {listed(s.name for s in self.segments)}"
        points = counted(len(self.reading.cloud), "point")
        return f"Reconstruction({present} of {segments}; {points}, {self.seconds:.1f} s)"


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """Cloud as a model has understood it: what both the network's surfaces and a registration start from.

    Attributes:
        reading: the cloud, in the input's frame and unit, and which of its points were understood.
        axes: of that frame.
        T_camera_input: into the camera frame.
        code: what the network made of the cloud; None without one.
        timings_s: seconds of each stage so far.
    """

    reading: Reading
    axes: CloudAxes
    T_camera_input: Transform
    code: EncodedCloud | None
    timings_s: Seconds

    @property
    def points(self) -> Points:
        """The object's points, in the input's frame and unit."""
        return self.reading.cloud.points

    @cached_property
    def seen(self) -> PointCloud:
        """The object's points in the camera frame."""
        return self.reading.cloud.transformed(self.T_camera_input)


def encode_frame(reading: Reading, model: Trained | None, axes: CloudAxes = "camera") -> EncodedFrame:
    """Encode the points that a hypothesis takes for the object's; without a network check them alone.

    Raises ``ValueError`` for unusable clouds.
    """
    points = reading.cloud.points
    T_camera_input = into_camera(points, axes)
    seconds = Seconds()
    seen = reading.cloud.transformed(T_camera_input)
    if model is None:
        checked_points(seen)
        return EncodedFrame(reading, axes, T_camera_input, None, seconds)
    with timed(seconds, "encode"):
        code = model.encode(seen)
    return EncodedFrame(reading, axes, T_camera_input, code, seconds)


def extract(seen: EncodedFrame, model: Trained, resolution: int = 128, label_points: bool = False) -> Reconstruction:
    """All segments of the object in an encoded cloud, hidden side included, as the network alone finds them.

    Args:
        seen: the cloud.
        model: the weights, as for ``seen``.
        resolution: cells along the longest side of the object's box.
        label_points: also say on which segment each point of the cloud lies (``Reconstruction.observed``).

    Raises ``ValueError`` where the model finds no segment at all.
    """
    names, colors = segment_names(model)
    seconds = dict(seen.timings_s)
    code = seen.code
    assert code is not None
    field = partial(model.logits, code)
    with timed(seconds, "locate"):
        box = locate(field, code.normalizer.invert(SEARCH_BOX))
    with timed(seconds, "extract"):
        extraction = extract_whole(field, box, resolution, names, colors, model.nested if model.segmented else ())
    with timed(seconds, "measure"):
        segments = measure(extraction, model, code)
    observed = None
    if label_points:
        with timed(seconds, "points"):
            observed = segment_points(field(seen.seen.points), seen.points, names, colors, model.calibration)
    result = Reconstruction(
        surfaces=extraction.surfaces,
        labels=extraction.grid,
        segments=segments,
        timings_s=seconds,
        evaluated=extraction.evaluated,
        clipped=bool(extraction.grid.touched_sides().any()),
        code=code,
        T_camera_input=seen.T_camera_input,
        reading=seen.reading,
        observed=observed,
        calibrated=model.calibrates,
    )
    return result if seen.axes == "camera" else turned_back(result)


@contextmanager
def timed(timings: Seconds, stage: str) -> Iterator[None]:
    """Add the seconds of a block to ``timings`` under the name of its stage."""
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start


def segment_names(model: Trained) -> tuple[Names, SegmentColors]:
    """Names and colours of the classes that the model tells apart; one trained on distances knows only the whole."""
    return (model.names, model.colors) if model.segmented else (("object",), PALETTE[:1])


def turned_back(result: Reconstruction) -> Reconstruction:
    """Result in the scanner's frame from that in the camera's: half a turn about x reverses the grid along y and z."""
    T_scanner_camera = inverse_rigid(result.T_camera_input)
    grid = result.labels
    last = np.asarray(grid.labels.shape) - 1
    corner = grid.origin + grid.spacing * last * np.array([0, 1, 1])
    labels = LabelGrid(
        np.ascontiguousarray(grid.labels[:, ::-1, ::-1]),
        transform_points(T_scanner_camera, corner),
        grid.spacing,
        grid.names,
    )
    segments = tuple(
        replace(
            segment,
            centroid=transform_points(T_scanner_camera, segment.centroid),
            box=np.sort(transform_points(T_scanner_camera, segment.box), axis=0),
        )
        for segment in result.segments
    )
    return replace(result, surfaces=result.surfaces.transformed(T_scanner_camera), labels=labels, segments=segments)


# --- segments in numbers ----------------------------------------------------------------------------------------------


def segment_points(
    logits: Rows,
    points: Points,
    names: Names,
    colors: SegmentColors,
    calibration: Calibration | None = None,
    labels: Labels | None = None,
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
    scaled = logits
    if calibration is not None:
        from mereo.models.model import scaled_array

        scaled = scaled_array(calibration.scaling, logits)
    parts = scaled[:, 1:].astype(float)
    return SegmentedCloud(
        points=points,
        labels=labels,
        confidence=np.take_along_axis(softmax(parts, axis=1), labels[:, None].astype(np.int64) - 1, axis=1)[:, 0],
        occupancy=expit(logsumexp(parts, axis=1) - scaled[:, 0]),
        names=names,
        colors=colors,
    )


SPECK = 0.1
"""Length of a group of voxels, as a share of the longest one's, below which a person sees a speck and not a part."""


def count_parts(voxels: VoxelMask) -> int:
    """Number of parts that voxels are in: groups that touch at faces, edges or corners, without the specks among them.

    A group is as long as the longest side of the box around its voxels' centres, so that a single voxel has no length.
    """
    boxes = ndimage.find_objects(ndimage.label(voxels, np.ones((3, 3, 3)))[0])
    lengths = [max(side.stop - side.start for side in box) - 1 for box in boxes]
    return sum(length >= SPECK * max(lengths) for length in lengths)


def measure(extraction: Extraction, model: Trained | None, code: EncodedCloud | None) -> tuple[SegmentFacts, ...]:
    """Every segment of an extraction in numbers; ``code`` is what ``model`` made of the cloud, None without one."""
    grid = extraction.grid
    measured = list[SegmentFacts]()
    owned = zip(extraction.surfaces.segments, extraction.surfaces.owned_volumes, strict=True)
    for label, (segment, volume) in enumerate(owned, start=1):
        voxels = np.argwhere(grid.labels == label)
        if len(voxels) == 0:
            nothing = np.full((2, 3), np.nan)
            measured.append(SegmentFacts(segment.name, label, 0.0, nothing[0], nothing, float("nan"), 0, 0))
            continue
        confidence = float("nan")
        if model is not None and code is not None:
            chosen = random_subset(voxels, CONFIDENCE_VOXELS)
            confidence = float(model.query(code, grid.positions(chosen)).probability[:, label].mean())
        part = grid.labels[part_of_grid(voxels.min(axis=0), voxels.max(axis=0) + 1)]
        measured.append(
            SegmentFacts(
                name=segment.name,
                label=label,
                volume=float(volume),
                centroid=grid.positions(voxels).mean(axis=0),
                box=segment.bounds,
                confidence=confidence,
                voxels=len(voxels),
                components=count_parts(part == label),
            )
        )
    return tuple(measured)
