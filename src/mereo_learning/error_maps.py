"""Error pictures after the paper's: what lies too far out or in, and wrong segments (figure of section 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from mereo.geometry.camera import PointCloud, camera_axes
from mereo.geometry.conventions import UNITS_M
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.visualization.color_scales import viridis
from mereo.visualization.contact_sheets import (
    INK,
    Picture,
    cloud_picture,
    contact_sheet,
    fit_font,
    legend,
    save_png,
)
from mereo.visualization.previews import CAMERA_VIEWS
from mereo.visualization.renderer import Canvas, Triangles, Vector, Viewpoint
from mereo_learning.cases import EvaluatedView
from mereo_learning.scans import ScanFile

CAMERA: tuple[Vector, Vector] = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Direction in which a camera looks, and what is up in its picture."""

COLUMNS = (
    *("point cloud", "reconstruction", "reconstruction error", "error from behind"),
    *("segmentation", "segmentation error", "reference"),
)
PLAIN: Color = (146, 170, 198)
PALE: Color = (222, 224, 228)
OVER: Color = (31, 119, 214)
UNDER: Color = (245, 130, 20)
WRONG: Color = (214, 39, 60)
EXTRA_OR_MISSING: Color = (240, 158, 168)
SEGMENTATION_WORDS = (
    "segmentation error: none",
    "another segment than in the reference",
    "a segment in one of the two, empty space in the other",
)
TOLERANCE_CELLS = 0.5
"""Surfaces that are no farther apart cannot be told apart on a grid; they count as right."""

FULL_CELLS = 3.0
"""From this distance on a surface has the full colour of ``OVER`` or ``UNDER``."""


def error_picture(path: str | Path, cases: Sequence[EvaluatedView], size: int = 240) -> None:
    """Write the paper's figure of reconstructions, one row for each case, eight columns, and a scale of the errors.

    Name, point cloud, reconstruction (all segments as one), reconstruction error (blue where the surface lies too far
    out, orange where it lies too far in), the same from behind, segmentation, segmentation error (anywhere it differs
    from the reference: red by another segment, light red where one of the two is empty), reference. What is right is
    pale.

    Args:
        path: the .png file.
        cases: the rows, seen by the camera.
        size: width and height of each picture in pixels.
    """
    images: list[Picture] = []
    captions: list[str] = []
    for case in cases:
        images += [name_plate(case.name, size // 2, size), *_error_row(case, size)]
        captions += ["", *COLUMNS]
    sheet = contact_sheet(images, captions, 1 + len(COLUMNS))
    strips = [
        _offset_scale(sheet.shape[1]),
        legend(SEGMENTATION_WORDS, (PALE, WRONG, EXTRA_OR_MISSING), sheet.shape[1]),
    ]
    save_png(path, np.concatenate([sheet, *strips]))


Shown = Literal["segmentation", "reconstruction error"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Pictures of the same views as several networks answer them, side by side.

    Attributes:
        shown: what is drawn of each answer.
        rows: views, one row for each object; those of a row are of one truth, from one camera.
        captions: words below each picture, as ``rows``.
    """

    shown: Shown
    rows: Sequence[Sequence[EvaluatedView]]
    captions: Sequence[Sequence[str]]


def comparison_picture(path: str | Path, comparison: Comparison, size: int = 320) -> None:
    """Write a picture of a comparison, seen by the camera: after the reference, a column for each network's answer.

    Args:
        path: the .png file.
        comparison: what is compared.
        size: width and height of each picture in pixels.
    """
    images: list[Picture] = []
    captions: list[str] = []
    for views, words in zip(comparison.rows, comparison.captions, strict=True):
        # around the truth, however far from it one of the answers strays
        front = Viewpoint.along(_bounds(replace(views[0], predicted=views[0].reference)), *CAMERA, margin=1.3)
        segments = np.asarray(views[0].colors, dtype=float).reshape(-1, 3)
        drawn = [_labelled(views[0], views[0].reference, segments)]
        for view in views:
            error = comparison.shown == "reconstruction error"
            drawn.append(offset_triangles(view) if error else _labelled(view, view.predicted, segments))
        images += [_solid_picture(triangles, front, size) for triangles in drawn]
        captions += [f"{views[0].name}, reference", *words]
    sheet = contact_sheet(images, captions, 1 + len(comparison.rows[0]))
    if comparison.shown == "reconstruction error":
        sheet = np.concatenate([sheet, _offset_scale(sheet.shape[1])])
    save_png(path, sheet)


def _offset_scale(width: int) -> Picture:
    """Scale of ``offset_colors``, for the foot of a picture."""
    colors = offset_colors(np.linspace(-FULL_CELLS, FULL_CELLS, 181))
    words = (f"-{FULL_CELLS:g}, too far in", "right", f"{FULL_CELLS:g}, too far out")
    return scale_bar(colors, "reconstruction error, in cells of the grid", words, width)


def _error_row(case: EvaluatedView, size: int) -> list[Picture]:
    direction, up = CAMERA
    front, behind = (Viewpoint.along(_bounds(case), tuple(sign * np.asarray(direction)), up) for sign in (1, -1))
    segments = np.asarray(case.colors, dtype=float).reshape(-1, 3)
    offset = offset_triangles(case)
    shown = (
        (_labelled(case, (case.predicted > 0).astype(np.uint8), [PLAIN]), front),
        (offset, front),
        (offset, behind),
        (_labelled(case, case.predicted, segments), front),
        (segmentation_triangles(case), front),
        (_labelled(case, case.reference, segments), front),
    )
    pictures = [_solid_picture(triangles, view, size) for triangles, view in shown]
    return [cloud_picture(case.cloud.points, front, (size, size)), *pictures]


def segmentation_error(case: EvaluatedView) -> UInt8[np.ndarray, "x y z"]:
    """Grid of where the segmentation differs from the reference: anywhere, as in the paper (appendix A).

    0 where both are empty, 1 where both are the same segment, 2 where they are different ones, 3 where one of the two
    is empty.
    """
    reference, predicted = case.reference, case.predicted
    both, either = (reference > 0) & (predicted > 0), (reference > 0) | (predicted > 0)
    kinds = np.select([~either, ~both, reference != predicted], [0, 3, 2], default=1)
    wrong: UInt8[np.ndarray, "x y z"] = kinds.astype(np.uint8)
    return wrong


def segmentation_triangles(case: EvaluatedView) -> Triangles:
    """Surface of truth and reconstruction together, coloured by ``segmentation_error``.

    Light red grows with the distance between the two surfaces as the colours of ``offset_triangles`` do. Where it is
    within ``TOLERANCE_CELLS``, so that rounding decides which cell is empty, the nearest cell of both shows instead.
    """
    kinds = segmentation_error(case)
    both = (kinds == 1) | (kinds == 2)
    beneath = kinds
    if both.any():
        beneath = kinds[tuple(distance_transform_edt(~both, case.spacing, return_distances=False, return_indices=True))]
    shown = np.where(kinds == 3, 2 + np.minimum(beneath, 2), kinds).astype(np.uint8)
    surface = _labelled(case, shown, [PALE, WRONG, PALE, WRONG])
    share = np.where(surface.owner > 2, np.repeat(_full_share(_union_offset(case, surface)), 2), 0.0)[:, None]
    colors = (1 - share) * surface.colors + share * np.asarray(EXTRA_OR_MISSING) / 255.0
    return replace(surface, colors=colors, owner=np.zeros_like(surface.owner))


def offset_triangles(case: EvaluatedView) -> Triangles:
    """Surface of truth and reconstruction together, coloured by the distance between them (``offset_colors``).

    So what was invented is seen, and what is missing as well, each the stronger the farther it is from the truth.
    """
    either = (case.reference > 0) | (case.predicted > 0)
    surface = _labelled(case, either.astype(np.uint8), [PALE])
    return replace(surface, colors=np.repeat(offset_colors(_union_offset(case, surface)) / 255.0, 2, axis=0))


def _union_offset(case: EvaluatedView, surface: Triangles) -> Float[np.ndarray, " n"]:
    """Offset in cells (``surface_offset``) at the middle of each of the squares of a surface of both together."""
    middles = surface.vertices.reshape(-1, 4, 3).mean(axis=1)
    positions = (middles - case.origin) / case.spacing
    return surface_offset(case.reference > 0, case.predicted > 0, case.spacing, positions)


def offset_colors(cells: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Colours of distances: pale up to ``TOLERANCE_CELLS``, then blue (above 0: too far out) or orange; 0..255."""
    share = _full_share(cells)[:, None]
    full = np.where(cells[:, None] > 0, np.asarray(OVER, dtype=float), np.asarray(UNDER, dtype=float))
    colors: Float[np.ndarray, "n 3"] = (1 - share) * np.asarray(PALE, dtype=float) + share * full
    return colors


def _full_share(cells: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Share of the full colour of an error at each distance: 0 within the tolerance, 1 from ``FULL_CELLS`` on."""
    share: Float[np.ndarray, " n"] = (np.abs(cells) - TOLERANCE_CELLS) / (FULL_CELLS - TOLERANCE_CELLS)
    return np.clip(share, 0.0, 1.0)


def _bounds(case: EvaluatedView) -> Float[np.ndarray, "2 3"]:
    """The box of the cloud and of every occupied voxel."""
    occupied = np.argwhere((case.reference > 0) | (case.predicted > 0))
    corners = [case.origin + (occupied + side) * case.spacing for side in (-0.5, 0.5)]
    points = np.concatenate([case.cloud.points, *corners])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _labelled(
    case: EvaluatedView, grid: UInt8[np.ndarray, "x y z"], colors: Sequence[Color] | Float[np.ndarray, "k 3"]
) -> Triangles:
    return voxel_triangles(grid, np.asarray(colors, dtype=float) / 255.0, case.origin, case.spacing)


def _solid_picture(shown: Triangles, view: Viewpoint, size: int) -> Picture:
    canvas = Canvas.empty(view, (size, size))
    canvas.draw_triangles(shown)
    return canvas.picture()


def voxel_triangles(
    grid: UInt8[np.ndarray, "x y z"],
    colors: Float[np.ndarray, "k 3"],
    origin: Float[np.ndarray, "3"],
    spacing: Float[np.ndarray, "3"],
) -> Triangles:
    """Faces between occupied voxels and empty space, coloured by value (``colors[value - 1]``, 0..1).

    Normals are those of the smoothed occupancy, so that a curved body does not look like a staircase.
    """
    padded = np.pad(grid, 1)
    occupied = padded > 0
    faces_of: list[tuple[np.ndarray, ...]] = []
    for axis, sign in product(range(3), (-1, 1)):
        exposed = np.argwhere(occupied & ~np.roll(occupied, -sign, axis=axis))
        corners = np.zeros((4, 3))  # counter-clockwise from outside
        corners[:, axis] = 0.5 * sign
        corners[:, (axis + 1) % 3] = np.array([-0.5, 0.5, 0.5, -0.5]) * sign
        corners[:, (axis + 2) % 3] = [-0.5, -0.5, 0.5, 0.5]
        faces_of.append((exposed, exposed[:, None] + corners, np.tile(sign * np.eye(3)[axis], (len(exposed), 1))))
    cells, quads, flat = (np.concatenate(column) for column in zip(*faces_of, strict=True))
    vertices = origin + (quads.reshape(-1, 3) - 1) * spacing
    first = 4 * np.arange(len(cells))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])], axis=1).reshape(-1, 3)
    value = padded[tuple(cells.T)].astype(np.int64)
    # normals: the unit gradient of the blurred occupancy, or the face's own where that vanishes
    blurred = gaussian_filter(occupied.astype(np.float32), 1.5)
    index = tuple(np.clip(np.rint(quads.mean(axis=1)).astype(int), 0, np.asarray(occupied.shape) - 1).T)
    normals = np.stack([-slope[index] for slope in np.gradient(blurred)], axis=1) / spacing
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6 / np.min(spacing), normals / np.maximum(length, 1e-30), flat)
    twice = np.repeat(np.arange(len(cells)), 2)
    return Triangles(
        vertices, faces, colors[value - 1][twice], np.repeat(normals[twice, None], 3, axis=1), value[twice]
    )


# --- distances between surfaces on grids ------------------------------------------------------------------------------

BORDER = 3
"""Empty cells put around a grid, so that its surface is closed where it touches the border."""


def cell_size(spacing: Float[np.ndarray, "3"]) -> float:
    """Longest side of a grid cell, which is what is meant by a cell as a unit of distance."""
    return float(np.max(spacing))


def surface_offset(
    reference: Bool[np.ndarray, "x y z"],
    predicted: Bool[np.ndarray, "x y z"],
    spacing: Float[np.ndarray, "3"],
    positions: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " n"]:
    """Signed distance between a predicted and the true surface, in cells, on the surface of both together.

    Where that is the predicted surface it is the distance to the truth, above 0 (too far out), where it is the true
    surface that to the prediction, below 0 (too far in). Where both fall together it is 0, exactly so for equal grids.
    In a part that one grid lacks it is as large as the way to the nearest place that both have.

    Args:
        reference: whether each cell is truly occupied.
        predicted: whether it is by the prediction.
        spacing: sides of a cell.
        positions: in grid coordinates, the centre of cell [0, 0, 0] at the origin.
    """
    true_side, predicted_side = (signed_distance(np.pad(grid, BORDER), spacing) for grid in (reference, predicted))
    # takes the staircase out of distances to a grid's surface
    difference = gaussian_filter(true_side - predicted_side, 0.5 * cell_size(spacing) / spacing)
    offset: Float[np.ndarray, " n"] = map_coordinates(difference, (positions + BORDER).T, order=1, mode="nearest")
    return offset / cell_size(spacing)


def signed_distance(occupied: Bool[np.ndarray, "x y z"], spacing: Float[np.ndarray, "3"]) -> Float[np.ndarray, "x y z"]:
    """Distance of every cell's centre to the faces between occupied and empty cells, below 0 in occupied cells.

    Where there are no such faces it is the grid's diagonal.
    """
    return _way_to(occupied, spacing) - _way_to(~occupied, spacing)


def _way_to(wanted: Bool[np.ndarray, "x y z"], spacing: Float[np.ndarray, "3"]) -> Float[np.ndarray, "x y z"]:
    """Distance of every other cell's centre to the ellipsoid that fills the nearest wanted cell; 0 in wanted ones.

    Corners of a staircase stand out from the slope that it means; ellipsoids have none. Where nothing is wanted it is
    the grid's diagonal.
    """
    if not wanted.any():
        return np.full(wanted.shape, float(np.linalg.norm(np.asarray(wanted.shape) * spacing)))
    away, nearest = distance_transform_edt(~wanted, spacing, return_indices=True)
    apart = np.sqrt(((nearest - np.indices(wanted.shape, dtype=np.int32)).astype(np.float32) ** 2).sum(axis=0))
    way: Float[np.ndarray, "x y z"] = away * (1.0 - 0.5 / np.maximum(apart, 1.0))
    return np.where(wanted, 0.0, way)


# --- scans on placed segments -----------------------------------------------------------------------------------------


def overlay(placed: SegmentedMesh, limit: float, cloud: PointCloud, scan: ScanFile) -> Picture:
    """Picture of a scan on the placed segments (top) and of its distance from them (bottom), from several sides.

    Distances beyond ``limit``, in the scan's unit, are red.
    """
    to_camera = camera_axes(scan.frame)
    mesh = placed.transformed(to_camera)
    chosen = np.random.default_rng(0).permutation(len(cloud))[:40_000]  # most points that a picture shows
    points = transform_points(to_camera, cloud.points[chosen])
    distance = Solids(mesh).nearest(points).distance
    views = {name: Viewpoint.along(mesh.bounds, *pair) for name, pair in CAMERA_VIEWS.items()}
    mm = 1000 * UNITS_M[scan.unit] * limit
    near = viridis(distance / limit) / 255
    colors = np.where((distance > limit)[:, None], (0.85, 0.1, 0.1), near)
    pictures = []
    for is_solid, ink, radius_px in ((True, np.zeros_like(points), 0.5), (False, colors, 1.2)):
        for view in views.values():
            canvas = Canvas.empty(view, (420, 420))
            if is_solid:
                canvas.draw_triangles(Triangles.of(mesh))
            canvas.draw_points(points, ink, radius_px)
            pictures.append(canvas.picture())
    captions = [f"scan on segments, {name}" for name in views]
    captions += [f"distance 0 (dark) to {mm:.2g} mm (bright), red: more"] * len(views)
    sheet = contact_sheet(pictures, captions, len(views), f"{scan.path.name} on {len(mesh.segments)} segments")
    return np.concatenate([sheet, legend(mesh.names, mesh.colors, sheet.shape[1])])


def scale_bar(
    colors: Float[np.ndarray, "n 3"], title: str, words: tuple[str, str, str], width: int
) -> UInt8[np.ndarray, "44 _ 3"]:
    """Strip with a bar of colours from left to right, its title before it, and words below its ends and its middle."""
    strip = Image.new("RGB", (width, 44), "white")
    pen = ImageDraw.Draw(strip)
    length = width // 4
    left = (width - length) // 2
    bar = np.broadcast_to(np.rint(colors).astype(np.uint8), (14, len(colors), 3))
    strip.paste(Image.fromarray(np.ascontiguousarray(bar)).resize((length, 14)), (left, 2))
    pen.text((left - 12, 9), title, fill=INK, font=fit_font(14, title, left - 24), anchor="rm")
    for place, word, anchor in zip((0, length // 2, length), words, ("lm", "mm", "rm"), strict=True):
        pen.text((left + place, 28), word, fill=INK, font=fit_font(14, word, length // 3), anchor=anchor)
    return np.asarray(strip)


def name_plate(name: str, width: int, height: int) -> Picture:
    """Caption as a picture of its own; it may have several lines."""
    longest = max(name.splitlines(), key=len, default="")
    plate = Image.new("RGB", (width, height), "white")
    pen = ImageDraw.Draw(plate)
    pen.text((width // 2, height // 2), name, fill=INK, font=fit_font(18, longest, width - 4), anchor="mm")
    return np.asarray(plate)
