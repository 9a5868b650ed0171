"""A small solid with known answers for the tests of simulated states: two boxes in a lattice of tetrahedra."""

from itertools import permutations

import numpy as np
from numpy import ndarray
from numpy.random import default_rng
from shapes import box

from mereo.deformation.tetrahedral import Tetrahedra
from mereo.geometry.mesh import Segment, SegmentedMesh

SIZE = (5, 3, 3)
"""Unit cubes along x, y and z, from 0."""


def lattice(jitter: float = 0.12) -> Tetrahedra:
    """Each cube as six tetrahedra (Kuhn), of both orientations; inner nodes out of line."""
    nodes = np.argwhere(np.ones(np.add(SIZE, 1))).astype(float)
    inner = ((nodes > 0) & (nodes < SIZE)).all(axis=1)
    nodes[inner] += default_rng(0).uniform(-jitter, jitter, size=(int(inner.sum()), 3))
    axes = np.eye(3, dtype=int)
    steps = np.array([np.cumsum([0 * axes[0], *axes[list(order)]], axis=0) for order in permutations((0, 1, 2))])
    corners = np.argwhere(np.ones(SIZE))[:, None, None] + steps
    elements = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(np.add(SIZE, 1)))
    return Tetrahedra(nodes, elements.reshape(-1, 4))


def fine(low: tuple[float, ...], high: tuple[float, ...], name: str, color: int) -> Segment:
    """A box with 192 faces."""
    part = box(low, high, name, color)
    vertices, faces = part.vertices, part.faces
    for _ in range(2):
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
        edges, number = np.unique(sides, axis=0, return_inverse=True)
        middle = len(vertices) + number.reshape(-1, 3)
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        a, b, c, ab, bc, ca = *faces.T, *middle.T
        faces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1).reshape(-1, 3)
    return Segment(name, part.color, vertices, faces)


def boxes() -> SegmentedMesh:
    """Side by side along x, a fifth of a unit inside of the lattice's surface, and `right` 0.05 beyond its end."""
    left, right = (0.2, 0.2, 0.2), (5.05, 2.8, 2.8)
    return SegmentedMesh((fine(left, (2.3, 2.8, 2.8), "left", 0), fine((2.3, 0.2, 0.2), right, "right", 1)))


def bent(points: ndarray, strength: float) -> ndarray:
    """A smooth bend and stretch; ``strength`` up to 1 keeps the lattice's tetrahedra the right way round."""
    x, y, z = points.T
    moved = [x + 0.2 * np.sin(y), y + 0.12 * x**2, z * (1 + 0.1 * np.cos(x))]
    return points + strength * (np.stack(moved, axis=1) - points)


STRENGTHS = np.linspace(-0.9, 0.9, 10)


def states() -> ndarray:
    """Node positions [10, n, 3]."""
    return np.stack([bent(lattice().nodes, strength) for strength in STRENGTHS])


# --- its states as other programs write them --------------------------------------------------------------------------


def pvd_text(files: list[str]) -> str:
    """A collection of files, one for each time step."""
    steps = [f'<DataSet timestep="{step / 7}" part="0" file="{file}"/>' for step, file in enumerate(files)]
    return f'<?xml version="1.0"?><VTKFile type="Collection"><Collection>{"".join(steps)}</Collection></VTKFile>'


def xdmf_text(nodes: ndarray, elements: ndarray, displacements: ndarray) -> str:
    """As dolfinx lays out a file: the mesh once, and a collection that includes it at each time step."""

    def item(array: ndarray, kind: str) -> str:
        size, text = " ".join(map(str, array.shape)), " ".join(map(repr, array.ravel().tolist()))
        return f'<DataItem Dimensions="{size}" NumberType="{kind}" Precision="8" Format="XML">{text}</DataItem>'

    mesh = "/Xdmf/Domain/Grid[@GridType='Uniform'][1]/*[self::Topology or self::Geometry]"
    steps = [
        f'<Grid Name="u" GridType="Uniform"><xi:include xpointer="xpointer({mesh})" /><Time Value="{step}" />'
        f'<Attribute Name="u" AttributeType="Vector" Center="Node">{item(moved, "Float")}</Attribute></Grid>'
        for step, moved in enumerate(displacements)
    ]
    return f"""<?xml version="1.0"?>
        <!DOCTYPE Xdmf SYSTEM "Xdmf.dtd" []>
        <Xdmf Version="3.0" xmlns:xi="https://www.w3.org/2001/XInclude"><Domain>
        <Grid Name="mesh" GridType="Uniform">
        <Topology TopologyType="Tetrahedron" NumberOfElements="{len(elements)}">{item(elements, "Int")}</Topology>
        <Geometry GeometryType="XYZ">{item(nodes, "Float")}</Geometry></Grid>
        <Grid Name="u" GridType="Collection" CollectionType="Temporal">{"".join(steps)}</Grid></Domain></Xdmf>"""
