"""States of soft solids: modes of a free elastic body, on a lattice of tetrahedra that needs no mesher.

Linear elasticity gives a solid a stiffness K and a mass M; ``K v = lambda M v`` are its modes, of which the six without
energy are rigid motion. The prior is that of random smooth loads on a free body: a load f displaces it by ``K^+ f``, so
white loads make a mode's coefficient a normal number of standard deviation ~ 1 / lambda. (Thermal noise, the prior
exp(-energy), would have 1 / sqrt(lambda); it lets single places give way alone.) The scale of all is the root mean
square displacement of a material point.

Young's modulus and density of the whole cancel: the modes depend on the shape, on Poisson's ratio, on how much stiffer
some parts are than others, and on what is held. What this prior predicts of a real liver is measured in
docs/experiments/066.md.

Notation: n nodes, m tetrahedra, k modes; X are node positions at rest.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import eigh
from numpy.random import Generator, default_rng
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu
from scipy.spatial.transform import Rotation

from mereo.deformation.draw_names import named
from mereo.deformation.samplers import RandomMotion, Surface
from mereo.deformation.tetrahedral import Tetrahedra, TetrahedralMap
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.read_only import read_only, read_only_view
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import Flags, Values
from mereo.io.progress import stage

Modes = Float[ndarray, "n 3 k"]
"""Motion of each node in each mode."""

PerMode = Float[ndarray, " k"]
"""A number for each mode."""

_CORNERS = read_only(np.argwhere(np.ones((2, 2, 2))))
_SPLIT = read_only(np.array([[0, *np.cumsum([4 >> axis for axis in path])] for path in permutations(range(3))]))
"""Kuhn's six tetrahedra of a cube: from corner 0 to corner 7 along the axes in each order."""

SAMPLES = 3
"""Samples along each axis of a cell, from which the share of it that is filled is counted."""

SHIFT = 1e-5
"""Eigenvalues are sought about minus this share of the stiffest: below all modes, but far from the rigid ones."""


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity.

    Attributes:
        poisson: Poisson's ratio, between -1 and 0.5. Linear tetrahedra lock near 0.5: at 0.49 they are too stiff.
        young: Young's modulus, above 0, any unit; it scales the eigenvalues and changes no mode.

    Raises ``ValueError`` outside of these ranges.
    """

    poisson: float = 0.4
    young: float = 1.0

    def __post_init__(self) -> None:
        if not -1 < self.poisson < 0.5:
            raise ValueError(
                f"Poisson's ratio is {self.poisson:g}; it must lie between -1 and 0.5: take 0.4 for tissue"
            )
        if not 0 < self.young < inf:
            raise ValueError(f"Young's modulus is {self.young:g}; it must be above 0: take 1, which changes no mode")


@dataclass(frozen=True, eq=False)
class ElasticSolid:
    """Tetrahedra at rest, each with the share of it that is filled.

    Attributes:
        mesh: the tetrahedra; lengths in any unit.
        filled: shares, above 0 and at most 1; 1 in a mesh that follows the surface.
        stiffness: factor of Young's modulus of each, above 0; None where all are alike.

    Raises ``ValueError`` for other shares.
    """

    mesh: Tetrahedra
    filled: Float[ndarray, " m"]
    stiffness: Float[ndarray, " m"] | None = None

    def __post_init__(self) -> None:
        if not ((self.filled > 0) & (self.filled <= 1)).all():
            raise ValueError("the filled share of a tetrahedron must be above 0 and at most 1: leave empty ones out")
        object.__setattr__(self, "filled", read_only_view(self.filled))

    @property
    def volumes(self) -> Float[ndarray, " m"]:
        """Filled volume of each tetrahedron."""
        return np.abs(self.mesh.volumes) * self.filled

    @property
    def mass(self) -> Values:
        """Filled volume that belongs to each node, above 0."""
        corners = self.mesh.elements.ravel()
        shares = np.repeat(self.volumes / 4, 4)
        return np.bincount(corners, weights=shares, minlength=len(self.mesh.nodes))

    @property
    def cell(self) -> float:
        """Side of a cube of six of the largest tetrahedra: of a lattice, its cell's."""
        return float(np.cbrt(6 * np.abs(self.mesh.volumes).max()))

    @property
    def pieces(self) -> int:
        """Number of pieces; tetrahedra are of one where a chain of common faces joins them."""
        faces = np.sort(self.mesh.elements[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
        number = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
        rows = np.repeat(np.arange(len(self.mesh.elements)), 4)
        count = len(self.mesh.elements)
        incidence = coo_array((np.ones(len(rows)), (rows, number)), (count, int(number.max()) + 1)).tocsr()
        return int(connected_components(incidence @ incidence.T, directed=False)[0])

    def most_modes(self, held: Flags | None = None) -> int:
        """Number of modes that can be found, given which nodes are held."""
        free = len(self.mesh.nodes) if held is None else int((~held).sum())
        return 3 * free - 7


def build_lattice(mesh: SegmentedMesh, cells: int = 16, stiffness: Sequence[float] | None = None) -> ElasticSolid:
    """Cubic lattice around all segments of a mesh, ``cells`` (2 or more) cubes along its longest side.

    Every vertex of the mesh lies in a cube. A cube without sampled material, at a vertex, counts as half a sample. The
    ``stiffness`` of each segment, in that of a soft one, is averaged over the samples of a cube.

    Raises ``ValueError`` for too few cells, and for a mesh that has no inside.
    """
    if cells < 2:
        raise ValueError(f"a lattice of {cells} cells cannot bend; 2 or more are needed: take 16")
    low, high = mesh.bounds
    size = float((high - low).max()) / cells
    shape = np.ceil((high - low) / size + 0.5).astype(np.int64)
    origin = (low + high) / 2 - shape * size / 2
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y, z = (origin[a] + size * (np.arange(shape[a])[:, None] + places).ravel() for a in range(3))
    labels = label_grid(mesh, x, y, z).reshape(shape[0], SAMPLES, shape[1], SAMPLES, shape[2], SAMPLES)
    sampled = labels > 0
    if not sampled.any():
        raise ValueError("the mesh has no inside: turn its faces outward, or take more cells for a thin one")
    share = sampled.mean(axis=(1, 3, 5))
    vertices = np.concatenate([segment.vertices for segment in mesh.segments])
    touched = np.zeros(tuple(shape), bool)
    touched[tuple(np.clip(np.floor((vertices - origin) / size).astype(np.int64), 0, shape - 1).T)] = True
    cell = np.argwhere((share > 0) | touched)
    filled = np.maximum(share[tuple(cell.T)], 0.5 / SAMPLES**3)
    grid = tuple(int(nodes) for nodes in shape + 1)
    corners = np.ravel_multi_index(tuple(np.moveaxis(cell[:, None] + _CORNERS, -1, 0)), grid)
    used, packed = np.unique(corners, return_inverse=True)
    nodes = origin + size * np.stack(np.unravel_index(used, grid), axis=1)
    elements = packed.reshape(-1, 8)[:, _SPLIT].reshape(-1, 4)
    factor = None
    if stiffness is not None:
        stiff = np.concatenate([[0.0], stiffness])[labels].mean(axis=(1, 3, 5))
        mean = np.where(share > 0, stiff / np.maximum(share, 1e-12), 1.0)
        factor = np.repeat(mean[tuple(cell.T)], len(_SPLIT))
    return ElasticSolid(Tetrahedra(nodes, elements), np.repeat(filled, len(_SPLIT)), factor)


def assemble_stiffness(solid: ElasticSolid, material: Material) -> csc_array:
    """Stiffness [3n, 3n] of linear tetrahedra; coordinate i of node a is row 3 a + i."""
    g, nu = solid.mesh.shape_gradients, material.poisson
    shear, bulk = material.young / (2 * (1 + nu)), material.young * nu / ((1 + nu) * (1 - 2 * nu))  # Lame's mu, lambda
    blocks = shear * np.einsum("eak,ebk,ij->eaibj", g, g, np.eye(3))
    blocks += shear * np.einsum("eaj,ebi->eaibj", g, g) + bulk * np.einsum("eai,ebj->eaibj", g, g)
    weight = solid.volumes if solid.stiffness is None else solid.volumes * solid.stiffness
    blocks *= weight[:, None, None, None, None]
    rows = (3 * solid.mesh.elements[:, :, None] + np.arange(3)).reshape(-1, 12)
    place = np.repeat(rows, 12, axis=1).ravel(), np.tile(rows, (1, 12)).ravel()
    return coo_array((blocks.ravel(), place), (3 * len(solid.mesh.nodes),) * 2).tocsc()


def find_modes(solid: ElasticSolid, count: int, material: Material, held: Flags | None = None) -> tuple[PerMode, Modes]:
    """Eigenvalues, ascending, and modes of the free solid without its rigid motion, or of one that is held.

    Each mode moves material points by 1 unit of length, root mean square, and any two are orthogonal in the mass.

    Args:
        solid: n nodes.
        count: of modes.
        material: of all tetrahedra.
        held: nodes that do not move, 3 or more that are not in a line; None where all are free.

    Raises ``ValueError`` where there are not so many modes, for a solid that is not in one piece, and where what is
    held leaves it free to turn.
    """
    stiffness = assemble_stiffness(solid, material)
    mass = solid.mass
    rigid, free = (6, np.ones(len(mass), bool)) if held is None else (0, ~held)
    rows = np.flatnonzero(np.repeat(free, 3))
    most = solid.most_modes(held)
    if not 1 <= count <= most:
        raise ValueError(f"{count} modes of {len(rows) // 3} nodes; from 1 to {most} exist: take more cells for more")
    stiffness = stiffness[rows][:, rows].tocsc()
    weight = diags_array(np.repeat(mass[free], 3), format="csc")
    shift = -SHIFT * float(stiffness.diagonal().mean() / weight.diagonal().mean())
    inverse = LinearOperator(stiffness.shape, _factorize(stiffness - shift * weight).solve)
    start = default_rng(0).normal(size=len(rows))  # eigsh's own is another in each call
    values, vectors = eigsh(stiffness, count + rigid, M=weight, sigma=shift, OPinv=inverse, tol=1e-5, v0=start)
    order = np.argsort(values)[rigid:]
    if values[order[0]] < 0.01 * abs(shift):
        cause = (
            "it is not in one piece, or parts of it meet in an edge alone; take more cells, or a lattice for each piece"
        )
        if held is not None:
            cause = f"{cause}; or what is held leaves it free to turn: hold more of it"
        raise ValueError(f"the solid has motions without energy besides the six rigid ones: {cause}")
    signs = np.where(start @ vectors < 0, -1.0, 1.0)  # those of the solver are others on another processor
    modes = np.zeros((3 * len(mass), count))
    modes[rows] = (signs * vectors)[:, order]
    return values[order], modes.reshape(-1, 3, count) * np.sqrt(mass.sum())


def scale_modes(values: PerMode, modes: Modes, motion: float, power: float = 2.0) -> Modes:
    """Modes for coefficients of variance 1, mode v's standard deviation being ~ lambda^(-power / 2).

    Args:
        values: eigenvalues of ``find_modes``.
        modes: its modes.
        motion: root mean square displacement of all material points in all states, above 0, in the nodes' unit.
        power: 2 for random loads, 1 for thermal noise.

    Raises ``ValueError`` for a motion that is not above 0.
    """
    if not 0 < motion < inf:
        raise ValueError(f"the motion is {motion:g}; it must be above 0: a tenth of half the longest side is moderate")
    amplitude = (values / values[0]) ** (-power / 2)
    return modes * (amplitude * (motion / np.sqrt((amplitude**2).sum())))


class StateMap:
    """From coefficients of scaled modes to states of large deformation.

    Rotation-strain coordinates (Huang et al., "Interactive shape interpolation through controllable dynamic
    deformation", TVCG 2011): each tetrahedron strains by the exponential of its linear strain, then turns by that of
    its linear rotation. In linear modes a lobe that turns grows; here it keeps its volume nearly. The nodes are those
    whose gradients are nearest, by a Poisson system that is factorized once.

    ``Tetrahedra.volume_ratios`` shows where a state inverts a tetrahedron; ``ElasticSampler`` takes none of these.
    """

    def __init__(self, solid: ElasticSolid, modes: Modes) -> None:
        mesh = solid.mesh
        self.mesh, self.modes = mesh, read_only_view(modes)
        weighted = mesh.shape_gradients * solid.volumes[:, None, None]
        count = len(mesh.nodes)
        rows = np.repeat(mesh.elements, 3, axis=1).ravel()
        columns = np.arange(3 * len(mesh.elements)).reshape(-1, 1, 3).repeat(4, axis=1).ravel()
        shape = (count, 3 * len(mesh.elements))
        self._divergence: csr_array = coo_array((weighted.ravel(), (rows, columns)), shape).tocsr()
        gradient = coo_array((mesh.shape_gradients.ravel(), (rows, columns)), shape).tocsr()
        laplacian = self._divergence @ gradient.T
        # a shift of all nodes changes no gradient; this little stiffness settles it
        self._factors = _factorize((laplacian + 1e-9 * diags_array(laplacian.diagonal())).tocsc())
        self._share = solid.mass / solid.mass.sum()

    def __call__(self, coefficients: PerMode) -> TetrahedralMap:
        """Map of one state, normal coefficients of variance 1 giving the prior's; the centre of mass stays."""
        linear = self.mesh.gradients(self.mesh.nodes + self.modes @ coefficients)
        mirrored = np.swapaxes(linear, 1, 2)
        stretch, axes = eigh((linear + mirrored) / 2)
        strain = axes * np.exp(stretch - 1)[:, None] @ np.swapaxes(axes, 1, 2)
        spin = (linear - mirrored) / 2
        turn = Rotation.from_rotvec(np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)).as_matrix()
        gradients = np.swapaxes(turn @ strain, 1, 2).reshape(-1, 3)
        nodes = self._factors.solve(self._divergence @ gradients)
        return TetrahedralMap(self.mesh, nodes + self._share @ (self.mesh.nodes - nodes))


# --- random states ----------------------------------------------------------------------------------------------------

LEAST_RATIO = 0.1
"""Least volume of a tetrahedron in a drawn state, of that at rest."""

CALMER = 0.8
"""Factor of the coefficients of a state that would invert a tetrahedron or change the volume, until it does not."""

MOST_SWELLING = 0.02
"""Largest change of a drawn state's volume, as a share."""


_KEPT_MODES = dict[str, tuple[PerMode, Modes]]()
"""Modes of the last few solids by ``ElasticSampler.digest``: one command loads a scene several times."""


@dataclass(frozen=True, eq=False)
class ElasticSampler:
    """Random states of an elastic solid: normal coefficients of its modes, the smaller the more it would fold.

    Attributes:
        solid: what deforms.
        material: of it.
        count: of modes.
        motion: root mean square displacement of the prior, in the nodes' unit.
        held: nodes that do not move; None where all are free.

    The modes are computed with the first state, in a second or two.
    """

    solid: ElasticSolid
    material: Material
    count: int
    motion: float
    held: Flags | None = None

    def __getstate__(self) -> dict[str, Any]:
        """State without the factors of the Poisson system, which cannot be pickled; a first state makes them again."""
        return {key: value for key, value in self.__dict__.items() if key != "_state"}

    @cached_property
    def digest(self) -> str:
        """Digest of all that decides the modes but for their scale."""
        mesh = self.solid.mesh
        digest = hashlib.sha256(f"{self.material} {self.count}".encode())
        for part in (mesh.nodes, mesh.elements, self.solid.filled, self.solid.stiffness, self.held):
            digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
        return digest.hexdigest()

    @cached_property
    def modes(self) -> Modes:
        """Displacements of the nodes for coefficients of variance 1."""
        kept = _KEPT_MODES.get(self.digest)
        if kept is None:
            with stage("find the modes of the elastic solid, once"):
                kept = _KEPT_MODES[self.digest] = find_modes(self.solid, self.count, self.material, self.held)
            while len(_KEPT_MODES) > 4:
                _KEPT_MODES.pop(next(iter(_KEPT_MODES)), None)
        return scale_modes(*kept, self.motion)

    @cached_property
    def _state(self) -> StateMap:
        return StateMap(self.solid, self.modes)

    def __call__(self, rng: Generator, surface: Surface) -> TetrahedralMap:
        """A random state; no tetrahedron of it is inverted, and its volume is that at rest within ``MOST_SWELLING``."""
        coefficients = named(rng, "coefficients").normal(size=self.count)
        share = self.solid.volumes / self.solid.volumes.sum()
        while True:
            state = self._state(coefficients)
            ratios = self.solid.mesh.volume_ratios(state.nodes)
            if ratios.min() >= LEAST_RATIO and abs(share @ ratios - 1) <= MOST_SWELLING:
                return state
            coefficients = CALMER * coefficients


def elastic_motion(draw: object) -> ElasticSampler | None:
    """The elastic solid of a scene's random deformations; None where it is not all that moves all segments."""
    if not isinstance(draw, RandomMotion) or len(draw.steps) != 1:
        return None
    sampler, members = draw.steps[0]
    return sampler if isinstance(sampler, ElasticSampler) and len(members) == len(draw.rest.segments) else None


def _factorize(matrix: csc_array) -> SuperLU:
    """Factors of a symmetric positive definite matrix."""
    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
