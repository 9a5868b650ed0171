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

import numpy as np
from jaxtyping import Float

from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import PALETTE, Color, SegmentedMesh
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.models.trained import EncodedCloud, Trained, checked_points
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.isosurfaces import Field, extract_whole, locate
from mereo.reconstruction.segment_statistics import FoundSegment, measure, segment_points

SEARCH_BOX = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 2.5]])
"""Box in which segments are looked for first, normalized: the visible part fills [-1, 1], the hidden one is behind."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Object with all its segments, in the input's frame and units.

    Attributes:
        surfaces: every segment of the model as a closed mesh; without faces where it was not found. Which lie inside
            another is declared as in the model's scene.
        labels: the label grid.
        segments: each segment in numbers, in the same order.
        timings_s: seconds of each stage.
        evaluated: points at which the network was asked for surfaces.
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
    segments: tuple[FoundSegment, ...]
    timings_s: dict[str, float]
    evaluated: int
    clipped: bool
    code: EncodedCloud | None
    T_camera_input: Float[np.ndarray, "4 4"]
    reading: Reading
    observed: SegmentedCloud | None = None
    calibrated: bool = False

    @property
    def seconds(self) -> float:
        """Seconds of all stages together."""
        return sum(self.timings_s.values())

    def __repr__(self) -> str:
        found = sum(segment.voxels > 0 for segment in self.segments)
        segments = f"{counted(len(self.segments), 'segment')} found: {listed(s.name for s in self.segments)}"
        points = counted(len(self.reading.cloud), "point")
        return f"Reconstruction({found} of {segments}; {points}, {self.seconds:.1f} s)"


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
    T_camera_input: Float[np.ndarray, "4 4"]
    code: EncodedCloud | None
    timings_s: dict[str, float]

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """The object's points, in the input's frame and unit."""
        return self.reading.cloud.points

    @cached_property
    def seen(self) -> PointCloud:
        """The object's points in the camera frame."""
        return PointCloud(transform_points(self.T_camera_input, self.points))


def encode_frame(reading: Reading, model: Trained | None, axes: CloudAxes = "camera") -> EncodedFrame:
    """Encode the points that a hypothesis takes for the object's; without a network check them alone.

    Raises ``ValueError`` for unusable clouds.
    """
    points = reading.cloud.points
    T_camera_input = into_camera(points, axes)
    seconds: dict[str, float] = {}
    seen = PointCloud(transform_points(T_camera_input, points))
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
    seconds, code = dict(seen.timings_s), seen.code
    assert code is not None
    field: Field = partial(model.logits, code)
    with timed(seconds, "locate"):
        box = locate(field, code.normalizer.invert(SEARCH_BOX))
    with timed(seconds, "extract"):
        found = extract_whole(field, box, resolution, names, colors, model.nested if model.segmented else ())
    with timed(seconds, "measure"):
        segments = measure(found, model, code)
    observed = None
    if label_points:
        with timed(seconds, "points"):
            observed = segment_points(field(seen.seen.points), seen.points, names, colors, model.calibration)
    result = Reconstruction(
        surfaces=found.surfaces,
        labels=found.grid,
        segments=segments,
        timings_s=seconds,
        evaluated=found.evaluated,
        clipped=bool(found.grid.touched_sides().any()),
        code=code,
        T_camera_input=seen.T_camera_input,
        reading=seen.reading,
        observed=observed,
        calibrated=model.calibrates,
    )
    return result if seen.axes == "camera" else turned_back(result)


@contextmanager
def timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds of a block to ``timings`` under the name of its stage."""
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start


def segment_names(model: Trained) -> tuple[tuple[str, ...], tuple[Color, ...]]:
    """Names and colours of the classes that the model tells apart; one trained on distances knows only the whole."""
    return (model.names, model.colors) if model.segmented else (("object",), PALETTE[:1])


def turned_back(result: Reconstruction) -> Reconstruction:
    """Result in the scanner's frame from that in the camera's: half a turn about x reverses the grid along y and z."""
    T_scanner_camera, grid = inverse_rigid(result.T_camera_input), result.labels
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
