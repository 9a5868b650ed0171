"""A statistical model as a few small arrays, for a file of weights: with them alone, an object can be registered.

Modes are kept in one byte a coordinate, each mode with its own step; large ones, whose step would show, in two. The
library's coefficients are kept in steps of 0.04 standard deviations. With a limit in bytes the smallest modes go first.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Shaped

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.scenes.pair_distances import PairDistances
from mereo.scenes.statistical_model import StatisticalModel

Arrays = dict[str, Shaped[np.ndarray, "..."]]

FINE_STEP = 2e-4
"""Of half the rest box's longest side: modes that one byte resolves no better get two."""

LIBRARY_STEP = 0.04


def to_arrays(model: StatisticalModel, limit: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """The model as arrays, and what goes into a file's header.

    Raises ``ValueError`` where not even one mode fits into ``limit`` bytes.
    """
    count = model.count
    arrays = _arrays(model, count)
    if limit is not None:
        while (size := byte_count(arrays)) > limit and count > 0:
            each = model.modes[:, :, 0].size + len(model.library)
            count = max(0, count - max(1, (size - limit) // each))
            arrays = _arrays(model, count)
        if count == 0:
            raise ValueError(
                f"a statistical model of {len(model.mean)} points does not fit into {limit} bytes with a single mode; "
                "it needs more: raise the limit, or simplify the meshes"
            )
    segments = [
        {"name": s.name, "color": list(s.color), "solid": s.solid, "vertices": len(s.vertices), "faces": len(s.faces)}
        for s in model.rest.segments
    ]
    nested = [list(pair) for pair in model.rest.nested]
    return arrays, {"segments": segments, "nested": nested, "residue": model.residue, "half": model.half}


def byte_count(arrays: Arrays) -> int:
    """Of all arrays."""
    return sum(array.nbytes for array in arrays.values())


def _arrays(model: StatisticalModel, count: int) -> Arrays:
    modes = model.modes[:, :, :count]
    largest = np.abs(modes).max(axis=(0, 1), initial=0.0)
    fine = largest / 127 > FINE_STEP * model.half
    wide = np.flatnonzero(fine)
    narrow = np.flatnonzero(~fine)
    scale = np.maximum(largest, 1e-12) / np.where(fine, 32767, 127)
    library = np.clip(np.rint(model.library[:, :count] / LIBRARY_STEP), -127, 127)
    index = np.uint16 if max(model.vertex_counts) < 2**16 else np.int32
    return {
        "vertices": np.concatenate([s.vertices for s in model.rest.segments]).astype(np.float32),
        "faces": np.concatenate([s.faces for s in model.rest.segments]).astype(index),
        "nodes": model.nodes.astype(np.float32),
        "node_labels": model.node_labels,
        "mean": model.mean.astype(np.float32),
        "mode_steps": scale.astype(np.float32),
        "wide_modes": np.rint(modes[:, :, wide] / scale[wide]).astype(np.int16),
        "narrow_modes": np.rint(modes[:, :, narrow] / scale[narrow]).astype(np.int8),
        "wide": wide.astype(np.int32),
        "library": library.astype(np.int8),
        "pairs": np.stack([model.pairs.first, model.pairs.second]).astype(np.int32),
        "pair_distances": np.stack([model.pairs.mean, model.pairs.std]).astype(np.float32),
    }


def from_arrays(arrays: Arrays, header: dict[str, Any]) -> StatisticalModel:
    """Inverse of ``to_arrays``, up to rounding and modes that were left out."""
    vertices, faces = arrays["vertices"].astype(np.float64), arrays["faces"].astype(np.int64)
    segments, vertex, face = [], 0, 0
    for one in header["segments"]:
        last_vertex, last_face = vertex + one["vertices"], face + one["faces"]
        red, green, blue = one["color"]
        segments.append(
            Segment(one["name"], (red, green, blue), vertices[vertex:last_vertex], faces[face:last_face], one["solid"])
        )
        vertex, face = last_vertex, last_face
    rest = SegmentedMesh(tuple(segments), tuple((inner, outer) for inner, outer in header["nested"]))
    first, second = arrays["pairs"].astype(np.int64)
    mean, std = arrays["pair_distances"].astype(np.float64)
    return StatisticalModel(
        rest=rest,
        nodes=arrays["nodes"].astype(np.float64),
        node_labels=arrays["node_labels"],
        mean=arrays["mean"].astype(np.float64),
        modes=_modes(arrays),
        library=arrays["library"].astype(np.float32) * np.float32(LIBRARY_STEP),
        residue=float(header["residue"]),
        pairs=PairDistances(first, second, mean, std),
    )


def _modes(arrays: Arrays) -> Float32[np.ndarray, "m 3 k"]:
    steps: Float[np.ndarray, " k"] = arrays["mode_steps"]
    modes = np.empty((len(arrays["mean"]), 3, len(steps)), dtype=np.float32)
    wide = np.zeros(len(steps), dtype=bool)
    wide[arrays["wide"]] = True
    modes[:, :, wide], modes[:, :, ~wide] = arrays["wide_modes"], arrays["narrow_modes"]
    return modes * steps
