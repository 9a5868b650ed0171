"""What a scan can show of a placed object: the faces towards the scanner, and samples of them.

Notation: ``T_scan_segment`` maps rest coordinates (scene units) to the scan's frame and unit: a similarity. s segments.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mereo.geometry.downsampling import first_in_cell
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points

Poses = Float[np.ndarray, "s 4 4"]
"""``T_scan_segment`` of each segment, in label order."""

CONTACT = 0.005
"""Distance from another segment at rest below which faces are in contact with it, in diagonals of the object."""

FACING = -0.1
"""Least cosine between a face's normal and the way to the scanner; below 0, as the pose is not right yet."""

CLUSTER = 6
"""Number of points of one sample of the surface; five are the least from which the library estimates a normal."""

RING = 1e-3
"""Radius of a sample, in distances between samples."""


def diagonal(mesh: SegmentedMesh) -> float:
    """Length of the diagonal of the joint box of all segments."""
    low, high = mesh.bounds
    return float(np.linalg.norm(high - low))


def thinned(points: Float[np.ndarray, "n 3"], spacing: float) -> Float[np.ndarray, "p 3"]:
    """One of the points in each cell of a grid; not their mean, which would lie off a curved surface."""
    return points[first_in_cell(points - points.min(axis=0), spacing)]


def exposed(rest: SegmentedMesh) -> SegmentedMesh:
    """Faces that can be seen from outside: not inside another segment and not within ``CONTACT`` of one."""
    solids, reach = Solids(rest), CONTACT * diagonal(rest)
    inner = {index for index, _ in rest.nesting}
    shown = []
    for index, segment in enumerate(rest.segments):
        middles = segment.vertices[segment.faces].mean(axis=1)
        hidden = np.full(len(middles), index in inner)
        for other in set(range(solids.count)) - inner - {index}:
            hidden |= (solids.segment_distance(other, middles) < reach) | solids.inside(other, middles)
        shown.append(replace(segment, faces=segment.faces[~hidden]))
    return replace(rest, segments=tuple(shown))


def moved(mesh: SegmentedMesh, poses: Poses) -> SegmentedMesh:
    """Mesh whose segments are moved, each by its own transform."""
    pairs = zip(poses, mesh.segments, strict=True)
    return mesh.with_vertices([transform_points(pose, segment.vertices) for pose, segment in pairs])


def facing(placed: SegmentedMesh, viewpoint: Float[np.ndarray, "3"]) -> SegmentedMesh:
    """Faces that are turned towards ``viewpoint``, or nearly."""
    return replace(placed, segments=tuple(_facing(segment, viewpoint) for segment in placed.segments))


def _facing(segment: Segment, viewpoint: Float[np.ndarray, "3"]) -> Segment:
    corners = segment.vertices[segment.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    way = viewpoint - corners.mean(axis=1)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
    return replace(segment, faces=segment.faces[np.einsum("ij,ij->i", normal, way) > FACING * size])


def face_areas(mesh: SegmentedMesh) -> Float[np.ndarray, " f"]:
    """Areas of all faces, segment by segment."""
    vertices, faces, _ = mesh.merged()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def sample_surface(
    mesh: SegmentedMesh, area: float, least: int = 1000, most: int = 20_000
) -> Float[np.ndarray, "n c 3"]:
    """Samples spread evenly over the faces, one for each ``area``: tiny rings of ``CLUSTER`` points in the face.

    The library takes no normals but estimates them from neighbours. Rings make the estimate the face's own normal; from
    single points it is so rough that a ball seems to resist turning. The same places in every call.
    """
    areas = face_areas(mesh)
    rng = np.random.default_rng(0)
    count = int(np.clip(areas.sum() / area, least, most))
    vertices, faces, _ = mesh.merged()
    corners = vertices[faces[rng.choice(len(faces), size=count, p=areas / areas.sum())]]
    along, across = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    places = a * (1 - along) + b * along * (1 - across) + c * along * across
    first = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.cross(first, c - a)
    second = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), first)
    angle = np.linspace(0, 2 * np.pi, CLUSTER, endpoint=False)[:, None]
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    return places[:, None] + RING * np.sqrt(areas.sum() / count) * ring
