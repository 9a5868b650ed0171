"""Error pictures after the paper's: what lies too far out or in, and wrong segments (figure of section 4.2)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import gaussian_filter

from mereo.evaluation.results import EvaluatedView
from mereo.geometry.mesh import Color
from mereo.visualization.contact_sheets import Picture, cloud_picture, contact_sheet, name_plate, save_png, scale_bar
from mereo.visualization.renderer import Canvas, Triangles, Viewpoint
from mereo.visualization.surface_offsets import surface_offset

COLUMNS = (
    *("point cloud", "reconstruction", "reconstruction error", "error from behind"),
    *("segmentation", "segmentation error", "reference"),
)
PLAIN: Color = (146, 170, 198)
PALE: Color = (222, 224, 228)
OVER: Color = (31, 119, 214)
UNDER: Color = (245, 130, 20)
WRONG: Color = (214, 39, 60)
TOLERANCE_CELLS = 0.5
"""Surfaces that are no farther apart cannot be told apart on a grid; they count as right."""

FULL_CELLS = 3.0
"""From this distance on a surface has the full colour of ``OVER`` or ``UNDER``."""

SCALE_TITLE = "reconstruction error, in cells of the grid"
SCALE_WORDS = (f"-{FULL_CELLS:g}, too far in", "right", f"{FULL_CELLS:g}, too far out")


def error_picture(
    path: str | Path,
    cases: Sequence[EvaluatedView],
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
    size: int = 240,
) -> None:
    """Write the paper's figure of reconstructions, one row for each case, eight columns, and a scale of the errors.

    Name, point cloud, reconstruction (all segments as one), reconstruction error (blue where the surface lies too far
    out, orange where it lies too far in), the same from behind, segmentation, segmentation error (red where both are
    occupied, by different segments), reference. What is right is pale.

    Args:
        path: the .png file.
        cases: the rows.
        direction: where to look, in the cases' frame; the default is the camera's view.
        up: what is up in the picture, in the same frame.
        size: width and height of each picture in pixels.
    """
    images: list[Picture] = []
    captions: list[str] = []
    for case in cases:
        images += [name_plate(case.name, size // 2, size), *_error_row(case, direction, up, size)]
        captions += ["", *COLUMNS]
    sheet = contact_sheet(images, captions, 1 + len(COLUMNS))
    scale = offset_colors(np.linspace(-FULL_CELLS, FULL_CELLS, 181))
    save_png(path, np.concatenate([sheet, scale_bar(scale, SCALE_TITLE, SCALE_WORDS, sheet.shape[1])]))


def _error_row(
    case: EvaluatedView, direction: tuple[float, float, float], up: tuple[float, float, float], size: int
) -> list[Picture]:
    front, behind = (Viewpoint.along(_bounds(case), tuple(sign * np.asarray(direction)), up) for sign in (1, -1))
    segments = np.asarray(case.colors, dtype=float).reshape(-1, 3)
    found, wrong = _labelled(case, (case.predicted > 0).astype(np.uint8), [PLAIN]), segmentation_error(case)
    offset = offset_triangles(case)
    shown = (
        *((found, front), (offset, front), (offset, behind), (_labelled(case, case.predicted, segments), front)),
        *((_labelled(case, wrong, [PALE, WRONG]), front), (_labelled(case, case.reference, segments), front)),
    )
    pictures = [_solid_picture(triangles, view, size) for triangles, view in shown]
    return [cloud_picture(case.cloud.points, front, (size, size)), *pictures]


def segmentation_error(case: EvaluatedView) -> UInt8[np.ndarray, "x y z"]:
    """Grid of right and wrong segments: 1 where truth and prediction are the same, 2 where not, 0 if one is empty."""
    both = (case.reference > 0) & (case.predicted > 0)
    wrong: UInt8[np.ndarray, "x y z"] = (both * 1 + (both & (case.reference != case.predicted)) * 1).astype(np.uint8)
    return wrong


def offset_triangles(case: EvaluatedView) -> Triangles:
    """Surface of truth and reconstruction together, coloured by the distance between them (``offset_colors``).

    So what was invented is seen, and what is missing as well, each the stronger the farther it is from the truth.
    """
    reference, predicted = case.reference > 0, case.predicted > 0
    surface = voxel_triangles((reference | predicted).astype(np.uint8), np.zeros((1, 3)), case.origin, case.spacing)
    middles = surface.vertices.reshape(-1, 4, 3).mean(axis=1)
    cells = surface_offset(reference, predicted, case.spacing, (middles - case.origin) / case.spacing)
    return replace(surface, colors=np.repeat(offset_colors(cells) / 255.0, 2, axis=0))


def offset_colors(cells: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Colours of distances: pale up to ``TOLERANCE_CELLS``, then blue (above 0: too far out) or orange; 0..255."""
    share = np.clip((np.abs(cells) - TOLERANCE_CELLS) / (FULL_CELLS - TOLERANCE_CELLS), 0.0, 1.0)[:, None]
    full = np.where(cells[:, None] > 0, np.asarray(OVER, dtype=float), np.asarray(UNDER, dtype=float))
    colors: Float[np.ndarray, "n 3"] = (1 - share) * np.asarray(PALE, dtype=float) + share * full
    return colors


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
    cells, axes, signs = _exposed_faces(padded > 0)
    quads = _quad_corners(cells, axes, signs)
    vertices = origin + (quads.reshape(-1, 3) - 1) * spacing
    first = 4 * np.arange(len(cells))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])], axis=1).reshape(-1, 3)
    value = padded[tuple(cells.T)].astype(np.int64)
    normals = _smooth_normals(padded > 0, quads.mean(axis=1), axes, signs, spacing)
    twice = np.repeat(np.arange(len(cells)), 2)
    return Triangles(
        vertices, faces, colors[value - 1][twice], np.repeat(normals[twice, None], 3, axis=1), value[twice]
    )


def _exposed_faces(
    occupied: Bool[np.ndarray, "x y z"],
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Voxel, axis and side (-1, 1) of every face beside empty space; the border must be empty."""
    found = []
    for axis in range(3):
        for sign in (-1, 1):
            cells = np.argwhere(occupied & ~np.roll(occupied, -sign, axis=axis))
            found.append((cells, np.full(len(cells), axis), np.full(len(cells), sign)))
    cells, axes, signs = (np.concatenate(column) for column in zip(*found, strict=True))
    return cells, axes, signs


def _quad_corners(
    cells: Int[np.ndarray, "n 3"], axes: Int[np.ndarray, " n"], signs: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 3"]:
    """Corners of each face in grid coordinates, voxel centres at whole numbers, counter-clockwise from outside."""
    row = np.arange(len(cells))
    corners = np.repeat(cells[:, None].astype(float), 4, axis=1)
    corners[row, :, axes] += 0.5 * signs[:, None]
    corners[row, :, (axes + 1) % 3] += np.array([-0.5, 0.5, 0.5, -0.5]) * signs[:, None]
    corners[row, :, (axes + 2) % 3] += np.array([-0.5, -0.5, 0.5, 0.5])
    return corners


def _smooth_normals(
    occupied: Bool[np.ndarray, "x y z"],
    places: Float[np.ndarray, "n 3"],
    axes: Int[np.ndarray, " n"],
    signs: Int[np.ndarray, " n"],
    spacing: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 3"]:
    """Unit gradient of the blurred occupancy at each face, or the face's own normal where that vanishes."""
    blurred = gaussian_filter(occupied.astype(np.float32), 1.5)
    index = tuple(np.clip(np.rint(places).astype(int), 0, np.asarray(occupied.shape) - 1).T)
    normals = np.stack([-slope[index] for slope in np.gradient(blurred)], axis=1) / spacing
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    own = np.eye(3)[axes] * signs[:, None]
    return np.where(length > 1e-6 / np.min(spacing), normals / np.maximum(length, 1e-30), own)
