"""The body's skin weights as smooth functions of space, which move interior points too, and the body they pose.

MakeHuman gives the share of each bone at the skin. Inside the body a share is at first that of the nearest skin and
then diffuses within the body, not across the air to another limb, until it changes slowly enough for its joint: a turn
by an angle about a joint has the Jacobian ``1 + angle * grad w . (axis x (point - joint))``.
"""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from mereo.deformation.maps import crossing
from mereo.geometry.read_only import read_only
from mereo.geometry.solids import label_grid
from mereo_objects._human_joints import JOINTS, PARENTS, part_axes
from mereo_objects._human_parts import base, rest_mesh, skin_weights, to_scene

SPACING = 0.6
SHELL = 3.0
"""Nodes up to this many spacings outside the body have shares of their own."""

KEPT = 5000
"""Points up to which shares are kept: of a grid's they would take hundreds of megabytes, and no two grids are alike."""

TAIL = 0.005
STEPS = 3
"""Implicit steps of diffusion: with three the kernel is nearly a normal distribution."""


@dataclass(frozen=True, eq=False)
class ShareField:
    """Field of each joint's share in a point: trilinear between the nodes of a grid.

    Attributes:
        origin: of the grid.
        row: for each node a row of ``table``; nodes that have none of their own use that of the nearest one.
        table: for each node in and near the body its share in each joint, from 0 to 1, that of the children included.
    """

    origin: Float[np.ndarray, "3"]
    row: Int[np.ndarray, "x y z"]
    table: Float[np.ndarray, "r j"]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n j"]:
        """Shares of all joints in points."""
        at = np.clip((points - self.origin) / SPACING, 0.0, np.array(self.row.shape) - 1.001)
        cell = at.astype(np.int64)
        strides = np.array([self.row.shape[1] * self.row.shape[2], self.row.shape[2], 1])
        corners = np.array(list(np.ndindex(2, 2, 2)))
        rows = self.row.ravel()[(cell @ strides)[:, None] + corners @ strides]
        x, y, z = np.stack([1.0 - (at - cell), at - cell], axis=2).transpose(1, 0, 2)
        weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).ravel()
        # one sparse product instead of eight gathers
        ends = 8 * np.arange(len(points) + 1)
        shares: Float[np.ndarray, "n j"] = csr_matrix((weights, rows.ravel(), ends), (len(points), len(self.table))) @ (
            self.table
        )
        return shares


@cache
def share_field() -> ShareField:
    """Share field of the body at rest."""
    rest = rest_mesh()
    low, high = rest.bounds
    first = np.floor(low / SPACING - SHELL)
    last = np.ceil(high / SPACING + SHELL)
    # whole multiples of the spacing, so that left and right are treated alike
    axes = [SPACING * np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    inside = label_grid(rest, *axes) > 0
    away = distance_transform_edt(~inside)
    near = away <= SHELL
    number = np.full(inside.shape, -1)
    # the body's nodes come first, then those of a shell around it
    number[inside] = np.arange(inside.sum())
    number[near & ~inside] = inside.sum() + np.arange(near.sum() - inside.sum())
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)[inside]
    shares = _extended(_diffused(_nearest_skin(nodes), number), number)
    # without the tails: most points then take part in few joints, wholly or not at all
    table = np.clip((shares - TAIL) / (1.0 - 2 * TAIL), 0.0, 1.0)
    nearest = distance_transform_edt(~near, return_distances=False, return_indices=True)
    return ShareField(np.array([axis[0] for axis in axes]), number[tuple(nearest)], table)


def _nearest_skin(nodes: Float[np.ndarray, "r 3"]) -> Float[np.ndarray, "r j"]:
    """Each joint's share at the nearest eight skin vertices, by inverse squared distance; children's included."""
    vertices = base().vertices
    direct = np.zeros((len(vertices), len(JOINTS)))
    for bone, (rows, shares) in skin_weights().items():
        for column, joint in enumerate(JOINTS):
            starts, end = joint.skin
            if bone.startswith(starts) and bone.endswith(end):
                direct[rows, column] += shares
    for column in reversed(range(len(JOINTS))):
        if PARENTS[column] >= 0:
            direct[:, PARENTS[column]] += direct[:, column]
    skin = np.unique(base().faces)
    distance, row = cKDTree(to_scene(vertices[skin])).query(nodes, k=8)
    weight = 1.0 / np.maximum(distance, 1e-3) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("rk,rkj->rj", weight, np.clip(direct[skin[row]], 0.0, 1.0))


def _flow(number: Int[np.ndarray, "x y z"]) -> csr_matrix:
    """Laplacian of the graph of neighbouring nodes that have a number."""
    pairs = []
    for axis in range(3):
        first = np.moveaxis(number, axis, 0)[:-1].ravel()
        second = np.moveaxis(number, axis, 0)[1:].ravel()
        inside = (first >= 0) & (second >= 0)
        pairs.append(np.stack([first[inside], second[inside]]))
    i, j = np.concatenate(pairs, axis=1)
    size = number.max() + 1
    links = csr_matrix((np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(size, size))
    return csr_matrix(diags(np.asarray(links.sum(axis=1)).ravel()) - links)


def _diffused(shares: Float[np.ndarray, "r j"], number: Int[np.ndarray, "x y z"]) -> Float[np.ndarray, "r j"]:
    """Heat flow between the body's nodes, for each joint's own time; nothing leaves the body."""
    size = len(shares)
    flow = _flow(np.where(number < size, number, -1))
    result = shares.copy()
    for softness in {joint.softness for joint in JOINTS}:
        columns = [k for k, joint in enumerate(JOINTS) if joint.softness == softness]
        solver = splu((identity(size) + softness**2 / (2 * STEPS * SPACING**2) * flow).tocsc())
        for _ in range(STEPS):
            result[:, columns] = solver.solve(result[:, columns])
    return result


def _extended(shares: Float[np.ndarray, "r j"], number: Int[np.ndarray, "x y z"]) -> Float[np.ndarray, "n j"]:
    """Harmonic in the shell: steady heat between the body's nodes, which keep theirs, and an insulated outside."""
    size = len(shares)
    flow = _flow(number)
    shell = splu(flow[size:, size:].tocsc()).solve(-(flow[size:, :size] @ shares))
    return np.concatenate([shares, shell])


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Map of the body's shape, then its pose: every joint turns each point by the point's share of its angle.

    Angles are blended, not matrices, so every step stays a rotation and limbs do not collapse (cf. Kavan & Zara,
    "Spherical blend skinning", 2005). Joints turn from the leaves to the root, in rest coordinates.

    Attributes:
        rotations: of each joint, axis times radians.
        girth: of each part, by how much it is wider than at rest, as a fraction.
        stretch: along the height; the width changes by its inverse square root, so that the volume is kept.
    """

    rotations: Float[np.ndarray, "j 3"]
    girth: Float[np.ndarray, " j"]
    stretch: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Images of points, shaped and posed."""
        known = _kept_shares(np.asarray(points, dtype=np.float64).tobytes()) if len(points) <= KEPT else _shares(points)
        shares, turned = known
        moved = self._shaped(points, shares)
        heads = self.heads()
        angles = np.linalg.norm(self.rotations, axis=1)
        # Rodrigues' formula for a fixed axis is two products with these and their squares
        quarter = crossing(self.rotations / np.maximum(angles, 1e-12)[:, None])
        half = quarter @ quarter
        for index in reversed(range(len(JOINTS))):
            rows = turned[index]
            local = moved[rows] - heads[index]
            angle = (angles[index] * shares[rows, index])[:, None]
            moved[rows] += np.sin(angle) * (local @ quarter[index]) + (1.0 - np.cos(angle)) * (local @ half[index])
        return moved

    def heads(self) -> Float[np.ndarray, "j 3"]:
        """Places of the joints in the shaped body, before it is posed; girth leaves a part's axis where it is."""
        return part_axes()[1] * self._scale()

    def _scale(self) -> Float[np.ndarray, "3"]:
        return np.array([self.stretch**-0.5, self.stretch, self.stretch**-0.5])

    def _shaped(self, points: Float[np.ndarray, "n 3"], shares: Float[np.ndarray, "n j"]) -> Float[np.ndarray, "n 3"]:
        """Every part grows away from its axis, each point by its shares in the parts."""
        across, heads = part_axes()
        grown = (_exclusive_shares() * self.girth) @ across.reshape(-1, 9)
        shift = (_exclusive_shares() * self.girth) @ np.einsum("jab,jb->ja", across, heads)
        growth = np.einsum("nab,nb->na", (shares @ grown).reshape(-1, 3, 3), points) - shares @ shift
        return (points + growth) * self._scale()


def _shares(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n j"], tuple[Int[np.ndarray, " _"], ...]]:
    """Joints' shares in points, and which of them each joint turns."""
    shares = read_only(share_field()(points))
    return shares, tuple(np.flatnonzero(column > 1e-9) for column in shares.T)


@lru_cache(maxsize=16)
def _kept_shares(points: bytes) -> tuple[Float[np.ndarray, "n j"], tuple[Int[np.ndarray, " _"], ...]]:
    """The same of few points, kept: a fit asks every state for the same ones."""
    return _shares(np.frombuffer(points).reshape(-1, 3))


@cache
def _exclusive_shares() -> Float[np.ndarray, "j j"]:
    """``shares @ this`` are the shares of the parts alone, without what hangs from them."""
    direct = np.eye(len(JOINTS))
    for child, parent in enumerate(PARENTS):
        if parent >= 0:
            direct[child, parent] = -1.0
    return read_only(direct)
