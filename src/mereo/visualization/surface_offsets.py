"""Distance of a reconstructed surface from the true one, finer than the grids on which both are labelled."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

BLUR_CELLS = 0.5
"""Standard deviation of the blur that takes the staircase out of distances to a grid's surface."""

BORDER = 3
"""Empty cells put around a grid, so that its surface is closed where it touches the border."""


def cell_size(spacing: Float[np.ndarray, "3"]) -> float:
    """Longest side of a grid cell, which is what is meant by a cell as a unit of distance."""
    return float(np.max(spacing))


def surface_offset(
    reference: Bool[np.ndarray, "x y z"],
    predicted: Bool[np.ndarray, "x y z"],
    spacing: Float[np.ndarray, "3"],
    places: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " n"]:
    """Signed distance between a predicted and the true surface, in cells, on the surface of both together.

    Where that is the predicted surface it is the distance to the truth, above 0 (too far out), where it is the true
    surface that to the prediction, below 0 (too far in). Where both fall together it is 0, exactly so for equal grids.
    In a part that one grid lacks it is as large as the way to the nearest place that both have.

    Args:
        reference: whether each cell is truly occupied.
        predicted: whether it is by the prediction.
        spacing: sides of a cell.
        places: in grid coordinates, the centre of cell [0, 0, 0] at the origin.
    """
    true_side, found_side = (signed_distance(np.pad(grid, BORDER), spacing) for grid in (reference, predicted))
    difference = gaussian_filter(true_side - found_side, BLUR_CELLS * cell_size(spacing) / spacing)
    offset: Float[np.ndarray, " n"] = map_coordinates(difference, (places + BORDER).T, order=1, mode="nearest")
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
