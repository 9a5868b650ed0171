"""The rest pose: its coordinates, and its segments as signed distances on a grid (template.safetensors).

Rest coordinates are ``(rest - centre) / half`` of the joint rest box, ``half`` being half of its longest side, so that
the object fills [-1, 1] along its longest side.
"""

import hashlib

import numpy as np
from jaxtyping import Float16

from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Vector

TEMPLATE_NODES, TEMPLATE_REACH = 64, 1.25
"""Nodes of the grid along each axis, 0.04 apart, and the largest rest coordinate: what is farther is far outside."""

ROUNDED_TO = 7.3e-7
"""Vertices are rounded to this share of the longest side before they are hashed. It is no simple fraction, or the round
numbers of a design would lie halfway between two steps."""


def rest_frame(rest: SegmentedMesh) -> tuple[Vector, float]:
    """Centre and half of the longest side of the joint rest box."""
    low, high = rest.bounds
    return (low + high) / 2, float((high - low).max() / 2)


def rest_digest(rest: SegmentedMesh) -> str:
    """SHA-256 of the segments' faces and rounded vertices, the same on every machine.

    Processors differ in the last bits of a sine, and so of a vertex that is made by one.
    """
    low, high = rest.bounds
    step = ROUNDED_TO * (high - low).max()
    digest = hashlib.sha256()
    for segment in rest.segments:
        for array in (np.rint(segment.vertices / step), segment.faces):
            digest.update(np.ascontiguousarray(array, "<i8").tobytes())
    return digest.hexdigest()


def rest_distances(rest: SegmentedMesh) -> Float16[np.ndarray, "s n n n"]:
    """Signed distance to what each segment owns, negative inside, in rest coordinates; axes [segment, x, y, z]."""
    center, half = rest_frame(rest)
    axis = np.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) * half + center
    solids = Solids(rest)
    rows = [
        np.where(solids.inside(index, nodes), -1.0, 1.0) * solids.segment_distance(index, nodes)
        for index in range(solids.count)
    ]
    for inner, outer in rest.nesting:  # exact, because the inner segment lies inside
        rows[outer] = np.maximum(rows[outer], -rows[inner])
    return (np.stack(rows) / half).astype(np.float16).reshape(-1, *(TEMPLATE_NODES,) * 3)
