"""The paper's error pictures: over- and under-reconstruction, and wrong segments (figure of section 4.2)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import gaussian_filter

from mereo.evaluation.scoring import EvaluatedView
from mereo.geometry.mesh import Color
from mereo.visualization.contact_sheets import Picture, cloud_picture, contact_sheet, name_plate, save_png
from mereo.visualization.renderer import Canvas, Triangles, Viewpoint

COLUMNS = ("point cloud", "reconstruction", "reconstruction error", "segmentation", "segmentation error", "reference")
PLAIN: Color = (146, 170, 198)
PALE: Color = (222, 224, 228)
OVER: Color = (31, 119, 214)
UNDER: Color = (245, 130, 20)
WRONG: Color = (214, 39, 60)


def error_picture(
    path: str | Path,
    cases: Sequence[EvaluatedView],
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
    size: int = 240,
) -> None:
    """Write the paper's figure of reconstructions, one row for each case, seven columns.

    Name, point cloud, reconstruction (all segments as one), reconstruction error (over blue, under orange),
    segmentation, segmentation error (red where both are occupied, by different segments), reference. What is right is
    pale.

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
    save_png(path, contact_sheet(images, captions, 1 + len(COLUMNS)))


def _error_row(
    case: EvaluatedView, direction: tuple[float, float, float], up: tuple[float, float, float], size: int
) -> list[Picture]:
    view = Viewpoint.along(_bounds(case), direction, up)
    grids = error_grids(case.reference, case.predicted)
    segments = np.asarray(case.colors, dtype=float).reshape(-1, 3)
    shown = (
        (grids["reconstruction"], [PLAIN]),
        (grids["reconstruction error"], [PALE, OVER, UNDER]),
        (case.predicted, segments),
        (grids["segmentation error"], [PALE, WRONG]),
        (case.reference, segments),
    )
    voxels = [_voxel_picture(case, grid, np.asarray(colors, dtype=float), view, size) for grid, colors in shown]
    return [cloud_picture(case.cloud.points, view, (size, size)), *voxels]


def error_grids(
    reference: UInt8[np.ndarray, "x y z"], predicted: UInt8[np.ndarray, "x y z"]
) -> dict[str, UInt8[np.ndarray, "x y z"]]:
    """Where a prediction is wrong; 0 is not shown.

    ``reconstruction``: 1 where occupied. ``reconstruction error``: 1 right, 2 over- and 3 under-reconstructed.
    ``segmentation error``, where both are occupied: 1 right, 2 another segment.
    """
    there, found = reference > 0, predicted > 0
    both = there & found
    reconstruction = both * 1 + (found & ~there) * 2 + (there & ~found) * 3
    segmentation = both * 1 + (both & (reference != predicted)) * 1
    return {
        "reconstruction": found.astype(np.uint8),
        "reconstruction error": reconstruction.astype(np.uint8),
        "segmentation error": segmentation.astype(np.uint8),
    }


def _bounds(case: EvaluatedView) -> Float[np.ndarray, "2 3"]:
    """The box of the cloud and of every occupied voxel."""
    occupied = np.argwhere((case.reference > 0) | (case.predicted > 0))
    corners = [case.origin + (occupied + side) * case.spacing for side in (-0.5, 0.5)]
    points = np.concatenate([case.cloud.points, *corners])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _voxel_picture(
    case: EvaluatedView, grid: UInt8[np.ndarray, "x y z"], colors: Float[np.ndarray, "k 3"], view: Viewpoint, size: int
) -> Picture:
    canvas = Canvas.empty(view, (size, size))
    if grid.any():
        canvas.draw_triangles(voxel_triangles(grid, colors / 255.0, case.origin, case.spacing))
    return canvas.picture()


def voxel_triangles(
    grid: UInt8[np.ndarray, "x y z"],
    colors: Float[np.ndarray, "k 3"],
    origin: Float[np.ndarray, "3"],
    spacing: Float[np.ndarray, "3"],
) -> Triangles:
    """The faces between occupied voxels and empty space, coloured by value (``colors[value - 1]``, 0..1).

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
