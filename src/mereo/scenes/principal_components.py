"""Building the statistical model of an object from its states: alignment, then principal components."""

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from mereo.deformation.moving_least_squares import spread
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.procrustes import align_all
from mereo.geometry.transforms import fit_rigid
from mereo.scenes.pair_distances import kept_distances
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.statistical_model import StatisticalModel, material_points

PROCRUSTES_ROUNDS = 100

PROCRUSTES_POINTS = 600
"""Material points whose alignment decides that of all."""

GRAM_POINTS = 2000
"""Material points whose inner products make the modes' directions among the states."""

HELD_OUT = 0.05
"""Share of the states that the modes do not see: their distance from the model is its residue."""

LEAST_MOTION = 2e-4
"""Threshold, of half the rest box's longest side: modes whose root mean square motion is smaller are left out."""

PAIR_POINTS = 160
"""Material points among which distances are compared."""

MOST_MODES = 160


def build_model(
    rest: SegmentedMesh,
    nodes: Float[np.ndarray, "j 3"],
    node_labels: UInt8[np.ndarray, " j"],
    states: Float32[np.ndarray, "n m 3"],
    most: int = MOST_MODES,
) -> StatisticalModel:
    """Statistical model of random or recorded states.

    Args:
        rest: the segments at rest.
        nodes: further material points, inside; may be none.
        node_labels: their segments, 1 or more.
        states: positions of all material points in each state, in any pose.
        most: modes at most.

    Raises ``ValueError`` for fewer than two states.
    """
    if len(states) < 2:
        raise ValueError(
            f"a statistical model is asked of {len(states)} states; it needs 2 or more: record more states"
        )
    held_out = max(1, round(HELD_OUT * len(states)))
    mean, aligned = _aligned(material_points(rest, nodes), states)
    seen, unseen = aligned[:-held_out], aligned[-held_out:]
    _, half = rest_frame(rest)
    library, modes = _principal(seen, most, LEAST_MOTION * half)
    left = unseen - (unseen @ np.linalg.pinv(modes)) @ modes if len(modes) else unseen
    residue = float(np.sqrt((left.astype(np.float64) ** 2).sum() / (left.size / 3)))
    layout = np.ascontiguousarray(modes.reshape(len(modes), len(mean), 3).transpose(1, 2, 0))
    pairs = kept_distances(spread(material_points(rest, nodes), PAIR_POINTS), mean, layout, library, half)
    return StatisticalModel(rest, nodes, node_labels, mean, layout, library, residue, pairs)


def _aligned(
    rest: Float[np.ndarray, "m 3"], states: Float32[np.ndarray, "n m 3"]
) -> tuple[Float[np.ndarray, "m 3"], Float32[np.ndarray, "n c"]]:
    """The mean, turned as the rest pose, and the aligned states' differences from it."""
    few = spread(rest, PROCRUSTES_POINTS)
    rotation, center, mean = align_all(states[:, few], PROCRUSTES_ROUNDS, 1e-5 * float(np.ptp(rest, axis=0).max()))
    T = fit_rigid(mean.astype(np.float64), rest[few])
    rotation = (T[:3, :3] @ rotation).astype(np.float32)
    aligned = np.matmul(states - center[:, None], rotation.transpose(0, 2, 1)) + T[:3, 3].astype(np.float32)
    middle = aligned.mean(axis=0)
    return middle.astype(np.float64), (aligned - middle).reshape(len(states), -1)


def _principal(
    differences: Float32[np.ndarray, "n c"], most: int, least: float
) -> tuple[Float32[np.ndarray, "n k"], Float32[np.ndarray, "k c"]]:
    """Coefficients of the states, of unit variance, and the modes, largest first."""
    count, columns = differences.shape
    few = spread_columns(columns, GRAM_POINTS)
    part = differences[:, few]
    values, vectors = np.linalg.eigh((part @ part.T).astype(np.float64) / len(few) * 3)
    order = np.argsort(values)[::-1][:most]
    order = order[np.sqrt(np.maximum(values[order], 0.0) / count) > least]
    library = (vectors[:, order] * np.sqrt(count)).astype(np.float32)
    return library, library.T @ differences / np.float32(count)


def spread_columns(columns: int, points: int) -> Int[np.ndarray, " c"]:
    """Columns of about ``points`` evenly chosen material points."""
    step = max(1, columns // 3 // points)
    return (np.arange(0, columns // 3, step)[:, None] * 3 + np.arange(3)).ravel()
