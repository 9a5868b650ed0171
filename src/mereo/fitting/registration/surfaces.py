"""Surfaces, label grid and figures of a registered model: the same that the network's answer has.

EncodedFrame, Registration -registered_reconstruction-> Reconstruction
"""

import numpy as np
from jaxtyping import UInt8

from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.models.trained import Trained
from mereo.reconstruction.isosurfaces import Extraction
from mereo.reconstruction.pipeline import EncodedFrame, Reconstruction, timed, turned_back
from mereo.reconstruction.segment_statistics import measure, segment_points


def registered_reconstruction(
    seen: EncodedFrame,
    registration: Registration,
    model: Trained | None,
    resolution: int = 128,
    label_points: bool = False,
) -> Reconstruction:
    """Reconstruction that is the registered model itself, in the input's frame.

    Confidence stays the network's: its mean probability of a segment over the voxels that the registration gives it;
    NaN without a network.
    """
    seconds = {**seen.timings_s, "fit": registration.seconds}
    mesh = registration.mesh
    with timed(seconds, "label"):
        low, high = mesh.bounds
        grid = padded_label_grid(mesh, float((high - low).max()) / resolution)
    with timed(seconds, "measure"):
        segments = measure(Extraction(mesh, grid, 0), model, seen.code)
    observed = None
    if label_points:
        with timed(seconds, "points"):
            observed = _observed(seen, registration, model)
    result = Reconstruction(
        surfaces=mesh,
        labels=grid,
        segments=segments,
        timings_s=seconds,
        evaluated=0,
        clipped=False,
        code=seen.code,
        T_camera_input=seen.T_camera_input,
        reading=seen.reading,
        observed=observed,
        calibrated=model is not None and model.calibrates,
    )
    return result if seen.axes == "camera" else turned_back(result)


def _observed(seen: EncodedFrame, registration: Registration, model: Trained | None) -> SegmentedCloud:
    """Segment of each observed point by the registration, with a network's probabilities of it, or NaN."""
    points = seen.seen.points
    labels = nearest_labels(registration.solids, points)
    if model is None or seen.code is None:
        rest, unknown = registration.mesh, np.full(len(points), np.nan)
        return SegmentedCloud(seen.points, labels, unknown, unknown, rest.names, rest.colors)
    logits = model.logits(seen.code, points)
    return segment_points(logits, seen.points, model.names, model.colors, model.calibration, labels)


def padded_label_grid(mesh: SegmentedMesh, spacing: float) -> LabelGrid:
    """Labels of a mesh on a grid with one empty voxel around it."""
    low, high = mesh.bounds
    counts = np.ceil((high - low) / spacing).astype(int) + 3
    origin = (low + high - (counts - 1) * spacing) / 2
    x, y, z = (origin[axis] + np.arange(counts[axis]) * spacing for axis in range(3))
    labels: UInt8[np.ndarray, "x y z"] = label_grid(mesh, x, y, z)
    return LabelGrid(labels, origin, np.full(3, spacing), mesh.names)
