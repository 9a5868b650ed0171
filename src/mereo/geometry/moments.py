"""Volume and centre of what belongs to each segment of a mesh, and how they change with its vertices."""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from mereo.geometry.mesh import Segment, SegmentedMesh


def owned_centroids(mesh: SegmentedMesh) -> Float[np.ndarray, "s 3"]:
    """Centre of the volume that belongs to each segment: its mesh's without that of the segments nested in it."""
    volumes, moments = mesh.owned_volumes, np.stack([first_moment(segment) for segment in mesh.segments])
    for outer in range(len(moments)):  # the inner ones come first and are done
        moments[outer] -= sum((moments[inner] for inner, other in mesh.nesting if other == outer), np.zeros(3))
    centroids: Float[np.ndarray, "s 3"] = moments / volumes[:, None]
    return centroids


def first_moment(segment: Segment) -> Float[np.ndarray, "3"]:
    """Volume times centroid of a closed mesh (divergence theorem), by tetrahedra with one corner at its middle."""
    middle = segment.vertices.mean(axis=0)
    a, b, c = (segment.vertices[segment.faces[:, i]] - middle for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    moment: Float[np.ndarray, "3"] = (volume[:, None] * (a + b + c)).sum(axis=0) / 4.0 + volume.sum() * middle
    return moment


def owned_gradients(mesh: SegmentedMesh) -> Float[np.ndarray, "s 4 v 3"]:
    """Derivatives of each segment's own volume, then of its centroid's x, y, z, by the vertices of all segments.

    The vertices are those of ``mesh.merged()``.
    """
    ends = np.cumsum([0, *(len(segment.vertices) for segment in mesh.segments)])
    centers, volumes = owned_centroids(mesh), mesh.owned_volumes
    result = np.zeros((len(mesh.segments), 4, ends[-1], 3))
    for owner, center in enumerate(centers):
        inner = _directly_inside(mesh, owner)
        for index, sign in ((owner, 1.0), *((one, -1.0) for one in inner)):
            rows = slice(ends[index], ends[index + 1])
            result[owner, :, rows] = sign * _gradients(mesh.segments[index], center)
        # about the centroid the first moment is zero, so that the volume's change does not move it
        result[owner, 1:] /= volumes[owner]
    return result


def _directly_inside(mesh: SegmentedMesh, outer: int) -> list[int]:
    """Segments whose meshes bound the volume that belongs to a segment from within."""
    within = [inner for inner, other in mesh.nesting if other == outer]
    return [one for one in within if not any((one, other) in mesh.nesting for other in within)]


def _gradients(segment: Segment, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 v 3"]:
    """Derivatives of a mesh's volume, and of its first moment about an origin, by its vertices."""
    corners = segment.vertices[segment.faces] - origin
    area = np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]]) / 6.0  # of the volume, by each corner
    volume = np.einsum("fi,fi->f", corners[:, 0], area[:, 0])
    middle = corners.sum(axis=1) / 4.0
    moment = middle[:, None, :, None] * area[:, :, None] + volume[:, None, None, None] / 4.0 * np.eye(3)
    each = np.concatenate([area[:, :, None], moment], axis=2).reshape(3 * len(corners), 12)
    columns = np.arange(3 * len(corners))
    collect = csr_array(
        (np.ones(len(columns)), (segment.faces.ravel(), columns)), (len(segment.vertices), len(columns))
    )
    gradients: np.ndarray = (collect @ each).reshape(-1, 4, 3)
    return gradients.transpose(1, 0, 2)
