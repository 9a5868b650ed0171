"""``report.html``: one self-contained page that shows the input cloud and the segments, offline, in any browser.

The page is ``report.html`` beside this module with its data in place of one marker. Positions are 16-bit steps of the
joint box and travel as base64, so that the page stays under ``BUDGET_BYTES``; surfaces over the budget are coarsened
for the page only (``segments.glb`` keeps all).
"""

import base64
import json
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt16

from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.downsampling import random_subset
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.subdivision import split_at_creases
from mereo.io.atomic_files import atomic_file
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.io.writers.meshes import OUTER_OPACITY
from mereo.visualization.depth_picture import depth_data
from mereo.visualization.report_words import page_words
from mereo.visualization.sure_colors import SureColors, sure_colors
from mereo.visualization.units import UNKNOWN, Unit

BUDGET_BYTES = 5_000_000
"""Most bytes of a page."""

CLOUD_POINTS = 60_000
"""Most points of the cloud that the page shows."""

DATA_MARKER = "/*DATA*/null"
TITLE_MARKER = "<!--TITLE-->"
STEPS = 65535


def write_report(
    path: str | Path,
    cloud: PointCloud,
    surfaces: SegmentedMesh,
    summary: dict[str, Any],
    frame_rotation: Float[np.ndarray, "3 3"] = GLTF_CAMERA_ROTATION,
    unit: Unit = UNKNOWN,
    registered: Registration | None = None,
    depth: DepthImage | None = None,
) -> None:
    """Write the page of a reconstruction.

    Args:
        path: the .html file.
        cloud: the input, in its frame and units; at most ``CLOUD_POINTS`` of it are shown.
        surfaces: the segments in the same frame; those without faces are listed but not drawn, those
            around a nested one are drawn see-through.
        summary: what the page says in words; every key may be missing. ``title`` is text; ``segments`` is a list of
            ``{"name", "centroid" [3], "volume", "confidence" in 0..1}`` in the order of ``surfaces``; ``timings_s``
            maps stages to seconds; of the other texts and numbers those for people are listed (``report_words``).
        frame_rotation: rotation from the input's frame to the viewer's (x right, y up, z toward the viewer).
        unit: of the cloud's lengths; the page has millimetres and cubic centimetres where it is known.
        registered: the model that the last of ``surfaces`` are, in the cloud's frame, to show how sure they are.
        depth: the image that the cloud comes from, in its unit, where it comes from one.

    Raises ``ValueError`` when the page cannot be brought under the budget.
    """
    page = files("mereo.visualization").joinpath("report.html").read_text(encoding="utf-8")
    sure = None if registered is None else sure_colors(registered, unit)
    picture = None if depth is None else depth_data(depth, unit)
    data = _page_data(cloud, surfaces, page_words(summary, unit), np.asarray(frame_rotation), sure, picture)
    # "</script>" inside a name must not end the script; \u003c is the same character to JSON
    text = json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    title = data["words"]["title"]
    page = page.replace(TITLE_MARKER, escape(title)).replace(DATA_MARKER, text)
    encoded = page.encode("utf-8", errors="replace")
    if len(encoded) > BUDGET_BYTES:
        raise ValueError(f"the report has {len(encoded)} bytes; at most {BUDGET_BYTES}: shorten the summary")
    with atomic_file(path) as partial:
        partial.write_bytes(encoded)


def _page_data(
    cloud: PointCloud,
    surfaces: SegmentedMesh,
    words: dict[str, Any],
    rotation: Float[np.ndarray, "3 3"],
    sure: SureColors | None,
    depth: dict[str, Any] | None,
) -> dict[str, Any]:
    points = _thin(cloud.points)
    low, high = _joint_bounds(points, surfaces)
    marks = None if sure is None else sure.of_points(points)
    # binary room: the page's text takes the rest; base64 grows data by a third
    taken = len(json.dumps([words, depth]))
    room = int((BUDGET_BYTES - 300_000 - taken) * 3 / 4) - (6 + len(marks or ())) * len(points)
    shown = _fit(surfaces, float((high - low).max()), room)
    return {
        "low": low.tolist(),
        "high": high.tolist(),
        "rotation": rotation.tolist(),
        "cloud": {"count": len(cloud), "shown": len(points), "positions": _base64(_quantize(points, low, high))},
        "segments": [
            {
                "name": full.name,
                "color": list(full.color),
                "opacity": 1.0 if opaque else OUTER_OPACITY,
                "faces": len(full.faces),
                "positions": _base64(_quantize(part.vertices, low, high)),
                "indices": _base64(part.faces.astype("<u4")),
                "sure": None if sure is None else sure.of_surface(part),
            }
            for full, part, opaque in zip(surfaces.segments, shown, surfaces.opaque, strict=True)
        ],
        "coarsened": any(len(a.faces) != len(b.faces) for a, b in zip(surfaces.segments, shown, strict=True)),
        "words": words,
        "depth": depth,
        "sure": None if sure is None else sure.page_data(marks),
    }


def _thin(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The cloud, or ``CLOUD_POINTS`` of it in their order, the same every time."""
    return points[np.sort(random_subset(np.arange(len(points)), CLOUD_POINTS))]


def _joint_bounds(
    points: Float[np.ndarray, "n 3"], surfaces: SegmentedMesh
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    everything = np.concatenate([points, *(segment.vertices for segment in surfaces.segments)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    return low, np.maximum(high, low + 1e-9 * max(1.0, float(np.abs(low).max())))


def _quantize(
    points: Float[np.ndarray, "n 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> UInt16[np.ndarray, "n 3"]:
    return np.rint((points - low) / (high - low) * STEPS).astype("<u2")


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _fit(surfaces: SegmentedMesh, extent: float, room_bytes: int) -> list[Segment]:
    """The segments, split at their creases, and coarsened together until they take at most ``room_bytes``."""
    shown, cells = [split_at_creases(segment)[0] for segment in surfaces.segments], 400.0
    while (size := sum(7 * len(s.vertices) + 12 * len(s.faces) for s in shown)) > room_bytes and cells > 4:
        shown = [split_at_creases(cluster(segment, extent / cells))[0] for segment in surfaces.segments]
        # a surface meets about cells^2 cells of the grid; the factor keeps the last steps from crawling
        cells *= min(0.95, max(0.5, (max(room_bytes, 0) / size) ** 0.5))
    return shown


def cluster(segment: Segment, cell: float) -> Segment:
    """Coarser segment: vertices in one cell of a cubic grid become their mean, faces that collapse or repeat go.

    J. Rossignac and P. Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993. Fast and
    dependency-free; the result is for looking at and need not be closed.
    """
    inverse = _same(np.floor((segment.vertices - segment.vertices.min(axis=0)) / cell).astype(np.int64))[1]
    count = np.bincount(inverse)
    sums = [np.bincount(inverse, weights=segment.vertices[:, axis], minlength=len(count)) for axis in range(3)]
    faces: Int[np.ndarray, "f 3"] = inverse[segment.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    first = _same(np.sort(faces, axis=1))[0]
    return Segment(segment.name, segment.color, np.stack(sums, axis=1) / count[:, None], faces[np.sort(first)])


def _same(rows: Int[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " n"]]:
    """First place of each different row, and for each row which one it is; packed, because sorting rows is slow."""
    base = int(rows.max(initial=0)) + 1
    packed = (rows[:, 0] * base + rows[:, 1]) * base + rows[:, 2]
    _, first, inverse = np.unique(packed, return_index=True, return_inverse=True)
    return first, inverse
