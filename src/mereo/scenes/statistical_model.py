"""The object's own deformation model: the mean of its states and their principal components (Cootes et al., CVIU 1995).

States are brought rigidly onto their mean (Procrustes), so that what is left is deformation; the principal components
of the material points, surface vertices and interior nodes alike, are its modes. A coefficient of 1 is one standard
deviation, so the prior of the coefficients ``z`` is N(0, 1) each. Lengths are scene units.

Notation: m material points (first the vertices of ``rest.merged()``, then the nodes), k modes, n states.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from numpy.linalg import inv, norm, solve
from numpy.random import default_rng
from scipy.special import ndtri

from mereo.deformation.moving_least_squares import ANCHORS, Anchors, PointWeights, spread
from mereo.geometry.brief import counted, listed
from mereo.geometry.conventions import Facts, Names, WholeNumbers
from mereo.geometry.mesh import Faces, Segment, SegmentedMesh
from mereo.geometry.symmetry import TOLERANCE, Symmetry, find_symmetries
from mereo.geometry.transforms import Labels, Points, Transform, Values, Vector, fit_rigid, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.checked_tensors import Tensors, pack_tensors, read_content, unpack_tensors
from mereo.io.errors import reason
from mereo.io.object_storage import Place, write_whole
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.scene import SourceFrame

MaterialPoints = Float[ndarray, "m 3"]
"""Positions of the material points, in rows."""

PerMode = Float[ndarray, " k"]
"""A number for each mode."""

Rows = Int[ndarray, " r"] | slice
"""Some of the material points, by their indices."""

# --- distances that all states keep -----------------------------------------------------------------------------------

# A linear model of states is too wide where states are not linear: it stretches a rope that only bends, and shears a
# robot's links. Each pair here has a distance that varies far less among the states than under the model's own
# Gaussian. Together they say, without any code of the scene, what bends, what is rigid and what turns about what.

TRIED_STATES, TRIED_GAUSSIAN = 600, 300
"""States, and draws of the Gaussian, whose distances are compared."""

MOST_PAIRS = 1000
LEAST_RATIO = 2.0
"""Pairs whose distance varies at least so many times more under the Gaussian than among the states."""

FLOOR = 0.002
"""Least deviation, of half the rest box's longest side: no distance is taken to be known better."""


@dataclass(frozen=True, eq=False)
class PairDistances:
    """Pairs of material points, and mean and standard deviation of their distance; there may be none."""

    first: Int[ndarray, " q"]
    second: Int[ndarray, " q"]
    mean: Float[ndarray, " q"]
    std: Float[ndarray, " q"]

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def none(cls) -> "PairDistances":
        """No pairs."""
        return cls(*(np.empty(0, np.int64),) * 2, *(np.empty(0),) * 2)


def kept_distances(
    tried: Int[ndarray, " v"],
    mean: MaterialPoints,
    modes: Float32[ndarray, "m 3 k"],
    library: Float32[ndarray, "n k"],
    half: float,
) -> PairDistances:
    """Distances among the ``tried`` material points that the states keep; see ``LEAST_RATIO``.

    ``mean``, ``modes`` and ``library`` are the linear model's, ``half`` is half of the rest box's longest side.
    """
    rng = default_rng(0)
    first, second = np.triu_indices(len(tried), 1)
    middle = mean[tried].astype(np.float32)
    motion = modes[tried]
    states = library[rng.permutation(len(library))[:TRIED_STATES]]
    real = _distances(middle, motion, states)[:, first, second]
    drawn = rng.normal(size=(TRIED_GAUSSIAN, library.shape[1])).astype(np.float32)
    linear = _distances(middle, motion, drawn)[:, first, second]
    center = real.mean(axis=0)
    std = np.maximum(real.std(axis=0), FLOOR * half)
    kept = np.flatnonzero(np.sqrt(((linear - center) ** 2).mean(axis=0)) > LEAST_RATIO * std)
    if len(kept) > MOST_PAIRS:
        kept = np.sort(rng.choice(kept, MOST_PAIRS, replace=False))
    return PairDistances(tried[first[kept]], tried[second[kept]], center[kept].astype(float), std[kept].astype(float))


def _distances(
    mean: Float32[ndarray, "v 3"], modes: Float32[ndarray, "v 3 k"], z: Float32[ndarray, "n k"]
) -> Float32[ndarray, "n v v"]:
    """Between all pairs of points in each state."""
    points = mean + (z @ modes.reshape(3 * len(mean), z.shape[1]).T).reshape(len(z), -1, 3)
    squared = (points**2).sum(axis=2)
    product = np.matmul(points, points.transpose(0, 2, 1))
    return np.sqrt(np.maximum(squared[:, :, None] + squared[:, None] - 2 * product, 0.0))


# --- statistical model ------------------------------------------------------------------------------------------------

SPARSE, SILHOUETTE_VERTICES = 200, 1500
"""Material points by which states of the library are compared, and vertices compared with what a frame rules out."""

OF_REST: Names = (
    *("faces", "vertex_counts", "labels", "rest_points", "half", "rest_center"),
    *("anchors", "rest_anchors", "silhouette_vertices", "sparse"),
)
"""Derived values that depend on the rest pose alone."""

PROJECTIONS = 5
"""Rounds of alignment and least squares that express a state in modes."""


WIDER = 2.0
"""Motion of an elastic solid in its model, in that of the states that are drawn: real ones may go farther."""


@dataclass(frozen=True, eq=False)
class StatisticalModel:
    """Linear model of an object's states.

    Attributes:
        rest: the segments at rest.
        nodes, node_labels: further material points, inside the segments at rest; label i + 1 is segment i.
        mean: of the aligned states, turned as ``rest`` is.
        modes: motion of each material point for one standard deviation, largest first.
        library: coefficients of the states that the model was built from.
        residue: root mean square distance of held-out states from the model.
        pairs: distances that the states keep, which the linear model alone does not.
        source_frame: frame of the object's own files; None in models from before it was kept.
        is_normal: whether the states are the normal distribution of the modes itself, as those of an elastic solid or
            a mechanism, so that a fit's surroundings in the library say nothing more.
        is_held: whether parts of the object at rest do not move in its states, so that a pose of it is that of theirs.
        rests: whether the rest pose is one of its states; not where joints have other values, as is known. No file
            has it.
    """

    rest: SegmentedMesh
    nodes: Float[ndarray, "j 3"]
    node_labels: UInt8[ndarray, " j"]
    mean: MaterialPoints
    modes: Float32[ndarray, "m 3 k"]
    library: Float32[ndarray, "n k"]
    residue: float
    pairs: PairDistances
    source_frame: SourceFrame | None = None
    is_normal: bool = False
    is_held: bool = False
    rests: bool = True

    def __repr__(self) -> str:
        states = f"{counted(self.count, 'mode')} of {counted(len(self.library), 'state')}"
        return f"StatisticalModel({states}, residue {self.residue:.2g} units; {listed(self.rest.names)})"

    @cached_property
    def rest_z(self) -> PerMode:
        """Coefficients nearest to the rest pose; those of the mean where that is none of the states."""
        return self.project(self.rest_points)[1] if self.rests else np.zeros(self.count)

    @cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Turns of the rest pose that no frame tells from it."""
        return find_symmetries(self.rest, TOLERANCE)

    @property
    def swaps(self) -> tuple[WholeNumbers, ...]:
        """Exchanges of segments that no frame tells from the rest pose: for each segment the one in its place."""
        swaps = (tuple(i for i in each.lands_on if i is not None) for each in self.symmetries if each.swaps)
        return tuple(dict.fromkeys(swaps))

    @property
    def count(self) -> int:
        """Number of modes."""
        return self.modes.shape[2]

    @cached_property
    def faces(self) -> Faces:
        """Faces of all segments, as indices of material points."""
        return self.rest.merged()[1].astype(np.int64)

    @cached_property
    def vertex_counts(self) -> WholeNumbers:
        """Number of vertices of each segment."""
        return tuple(len(segment.vertices) for segment in self.rest.segments)

    @cached_property
    def labels(self) -> UInt8[ndarray, " m"]:
        """Label of each material point."""
        owner = np.repeat(np.arange(len(self.vertex_counts)), self.vertex_counts)
        return np.concatenate([owner + 1, self.node_labels]).astype(np.uint8)

    @cached_property
    def rest_points(self) -> MaterialPoints:
        """All material points at rest."""
        return material_points(self.rest, self.nodes)

    def source_points(self, scene_unit: float) -> MaterialPoints:
        """Material points at rest in the frame of the object's own files, in a unit of which a scene unit has some."""
        if self.source_frame is None:
            return scene_unit * self.rest_points
        T_source_scene = inv(self.source_frame.T_scene_source)
        return scene_unit * self.source_frame.scale * transform_points(T_source_scene, self.rest_points)

    @cached_property
    def half(self) -> float:
        """Half of the rest box's longest side."""
        return rest_frame(self.rest)[1]

    @cached_property
    def rest_center(self) -> Vector:
        """Middle of the rest box."""
        return rest_frame(self.rest)[0]

    @cached_property
    def anchors(self) -> tuple[Int[ndarray, " a"], ...]:
        """Anchors of each segment: the material points that others of it follow."""
        *firsts, count = np.cumsum([0, *self.vertex_counts])
        return tuple(
            np.concatenate([first + spread(part.vertices, ANCHORS), count + np.flatnonzero(self.node_labels == label)])
            for label, (first, part) in enumerate(zip(firsts, self.rest.segments, strict=True), start=1)
        )

    @cached_property
    def rest_anchors(self) -> tuple[Anchors, ...]:
        """Anchors of each segment at rest."""
        return tuple(Anchors(index, self.rest_points[index]) for index in self.anchors)

    @cached_property
    def silhouette_vertices(self) -> Int[ndarray, " w"]:
        """Surface vertices, evenly spread."""
        return spread(self.rest_points[: sum(self.vertex_counts)], SILHOUETTE_VERTICES)

    @cached_property
    def sparse(self) -> Int[ndarray, " p"]:
        """A few material points that tell shapes apart."""
        return spread(self.rest_points, SPARSE)

    @cached_property
    def sparse_library(self) -> Float32[ndarray, "n p 3"]:
        """Positions of these few in all states of the library."""
        return self.positions(self.library, self.sparse).astype(np.float32)

    def around(self, mean: MaterialPoints, modes: Float32[ndarray, "m 3 d"]) -> "StatisticalModel":
        """Linear model of a state of the same object that is known but for these modes, without kept distances.

        What depends on rest alone is shared.
        """
        library = np.zeros((0, modes.shape[2]), np.float32)
        other = replace(self, mean=mean, modes=modes, library=library, residue=0.0, pairs=PairDistances.none())
        vars(other).update({name: getattr(self, name) for name in OF_REST})
        return other

    def material(self, z: PerMode) -> MaterialPoints:
        """Positions of all material points, unposed."""
        return self.mean + (self.modes.reshape(3 * len(self.modes), self.count) @ z.astype(np.float32)).reshape(-1, 3)

    def positions(self, z: Float[ndarray, "n k"], rows: Rows = slice(None)) -> Float[ndarray, "n r 3"]:
        """Positions of some material points in states, unposed."""
        mean, modes = self.mean[rows], self.modes[rows]
        motion = z.astype(np.float32) @ modes.reshape(mean.size, self.count).T
        return mean + motion.reshape(len(z), *mean.shape).astype(float)

    def tangent(self, z: PerMode, rows: Rows = slice(None)) -> Float32[ndarray, "r 3 k"]:
        """Motion of some material points for one standard deviation of each mode, at a state: everywhere the same."""
        return self.modes[rows]

    def residue_at(self, z: PerMode) -> float:
        """Root mean square distance of a state of these coefficients from what they express, scene units.

        That of a solid grows with the square of how far it is bent: its modes are how it moves from rest.
        """
        if not self.is_normal or not self.count:
            return self.residue
        return self.residue * float(WIDER * norm(self.motion * z) / norm(self.motion)) ** 2

    @property
    def registered(self) -> "StatisticalModel":
        """The model in which a state is kept: itself."""
        return self

    @cached_property
    def motion(self) -> PerMode:
        """Root mean square motion of the material points for one standard deviation of each mode."""
        squared = np.einsum("mck,mck->k", self.modes, self.modes, dtype=float)
        return np.sqrt(squared / len(self.modes))

    @cached_property
    def explained(self) -> PerMode:
        """Share of the states' variance that the first 1 ... k modes explain together."""
        variance = np.cumsum(self.motion**2)
        return variance / (variance[-1] + self.residue**2) if self.count else variance

    @cached_property
    def residues(self) -> Values:
        """Root mean square distance of a state that the model has not seen, by its first 0 ... k modes."""
        left = np.concatenate([np.cumsum(self.motion[::-1] ** 2)[::-1], [0.0]])
        return np.sqrt(left + self.residue**2)

    def modes_for(self, residue: float) -> int | None:
        """Fewest modes that leave no more than this root mean square distance; None where all leave more."""
        return next(iter(np.flatnonzero(self.residues <= residue).tolist()), None)

    def beyond(self, z: PerMode) -> float:
        """How far a state lies outside the range of the library's states: root mean square of the material points.

        A coefficient that any state of the library reaches is within; lengths are scene units.
        """
        low = self.library.min(axis=0)
        high = self.library.max(axis=0)
        excess = np.maximum(np.maximum(z - high, low - z), 0.0) * self.motion
        return float(np.sqrt((excess**2).sum()))

    @cached_property
    def _squares(self) -> Values:
        """Logarithms of the library's mean squared coefficients, in order."""
        squares = (self.library.astype(float) ** 2).mean(axis=1)
        return np.log(np.sort(np.maximum(squares, np.finfo(float).tiny)))

    def unusual(self, z: PerMode) -> float:
        """How improbable a state is that is bent so far, in standard deviations: by the library's states bent farther.

        A normal number is as rarely as large. Beyond all of the library, it goes on as from its median to its largest.
        """
        levels = self._squares
        middle = np.median(self._squares)
        level = np.log(max((z**2).mean(), np.finfo(float).tiny))
        within = np.interp(level, levels, ndtri((np.arange(len(levels)) + 0.5) / len(levels)))
        far = (level - middle) / max(levels[-1] - middle, np.finfo(float).eps)
        return float(within * max(far, 1.0))

    def mesh(self, material: MaterialPoints) -> SegmentedMesh:
        """The segments, with the rest mesh's faces, at these positions."""
        ends = np.cumsum(self.vertex_counts)
        return self.rest.with_vertices(np.split(material[: ends[-1]].astype(float), ends[:-1]))

    def weights(self, points: Points, labels: Labels) -> PointWeights:
        """Weights by which points at rest, of the segments ``labels`` (1 or more), follow the material points."""
        return following(self.rest_anchors, points, labels)

    def project(self, material: MaterialPoints) -> tuple[Transform, PerMode]:
        """Pose and coefficients of a state: ``T_state_model`` and z of (nearly) least squared distance."""
        flat = self.modes.reshape(3 * len(self.modes), self.count).astype(float)
        normal = flat.T @ flat + 1e-9 * np.trace(flat.T @ flat) * np.eye(self.count)
        z = np.zeros(self.count)
        for _ in range(PROJECTIONS):
            T = fit_rigid(self.mean + (flat @ z).reshape(-1, 3), material)
            unposed = (material - T[:3, 3]) @ T[:3, :3]
            z = solve(normal, flat.T @ (unposed - self.mean).ravel())
        return fit_rigid(self.mean + (flat @ z).reshape(-1, 3), material), z


def material_points(mesh: SegmentedMesh, nodes: Float[ndarray, "j 3"]) -> MaterialPoints:
    """Vertices of all segments, then the nodes."""
    return np.concatenate([*(segment.vertices for segment in mesh.segments), nodes])


def following(anchors: tuple[Anchors, ...], points: Points, labels: Labels) -> PointWeights:
    """Weights of points by the anchors of their own segments."""
    width = max((min(len(a.index), 32) for a in anchors), default=1)
    index = np.zeros((len(points), width), np.int64)
    weight = np.zeros((len(points), width))
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        followed = anchors[label - 1].weights(points[rows])
        count = followed.index.shape[1]
        index[rows, :count], weight[rows, :count] = followed.index, followed.weight
    return PointWeights(index, weight)


# --- files ------------------------------------------------------------------------------------------------------------

# Modes and the library of states are bytes: each mode in 254 steps of its largest motion, the first few, which move
# most, in 65,534, and each coefficient in steps of a 32nd of a standard deviation. A hundred modes of 6,000 material
# points are 2 MB, and rounding moves points by about a hundredth of a scene unit, a tenth of the paper's noise. Rest
# pose and mean keep float32.
#
# Notation: v vertices, m material points, k modes, n states, q pairs.

LIBRARY_STEP = 1 / 32
WIDE_MODES = 12
"""Step of a coefficient, whose bytes reach to 4 standard deviations, and how many first modes have two bytes."""


def pack_model(model: StatisticalModel) -> tuple[dict[str, ndarray], JsonObject]:
    """Tensors of a statistical model, and the facts about it that are none: names, colours, sizes, residue."""
    wide, wide_scale = _integers(model.modes[..., :WIDE_MODES], np.int16)
    narrow, narrow_scale = _integers(model.modes[..., WIDE_MODES:], np.int8)
    library = np.clip(np.rint(model.library / LIBRARY_STEP), -127, 127).astype(np.int8)
    vertices, faces, _ = model.rest.merged()
    tensors = {
        "vertices": vertices.astype(np.float32),
        "faces": _narrow(faces),
        "nodes": model.nodes.astype(np.float32),
        "node_labels": model.node_labels,
        "mean": model.mean.astype(np.float32),
        "wide_modes": wide,
        "modes": narrow,
        "mode_scale": np.concatenate([wide_scale, narrow_scale]),
        "library": library,
        "pair_index": _narrow(np.stack([model.pairs.first, model.pairs.second])),
        "pair_distance": np.stack([model.pairs.mean, model.pairs.std]).astype(np.float32),
    }
    segments = model.rest.segments
    facts = {
        "names": list(model.rest.names),
        "colors": [list(color) for color in model.rest.colors],
        "nested": [list(pair) for pair in model.rest.nested],
        "solid": [segment.solid for segment in segments],
        "vertices": [len(segment.vertices) for segment in segments],
        "faces": [len(segment.faces) for segment in segments],
        "residue": model.residue,
        "is_normal": model.is_normal,
        "is_held": model.is_held,
        "frame": None if model.source_frame is None else model.source_frame.facts(),
    }
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}, facts


def unpack_model(tensors: Tensors, facts: Facts) -> StatisticalModel:
    """Inverse of ``pack_model`` up to rounding."""
    index, (mean, std) = tensors["pair_index"].astype(np.int64), tensors["pair_distance"].astype(float)
    steps = np.concatenate([tensors["wide_modes"], tensors["modes"]], axis=2, dtype=np.float32)
    return StatisticalModel(
        rest=_rest(tensors, facts),
        nodes=tensors["nodes"].astype(float),
        node_labels=tensors["node_labels"],
        mean=tensors["mean"].astype(float),
        modes=steps * tensors["mode_scale"],
        library=tensors["library"].astype(np.float32) * np.float32(LIBRARY_STEP),
        residue=float(facts["residue"]),
        pairs=PairDistances(index[0], index[1], mean, std),
        source_frame=SourceFrame.of_facts(facts.get("frame")),  # older files have none
        is_normal=bool(facts.get("is_normal", False)),
        is_held=bool(facts.get("is_held", False)),
    )


def save_statistical_model(model: StatisticalModel, path: Path) -> None:
    """Write a statistical model as one safetensors file, whole or not at all."""
    write_whole(path, statistical_model_bytes(model))


def statistical_model_bytes(model: StatisticalModel, dataset: str | None = None) -> bytes:
    """Content of the file of a statistical model."""
    tensors, facts = pack_model(model)
    return pack_tensors(tensors, {**facts, "dataset": dataset})


def load_statistical_model(path: Place, dataset: str | None = None) -> StatisticalModel:
    """Read what ``save_statistical_model`` wrote; ``ValueError`` for another file, or one of another dataset.

    Raises ``StorageError`` where nothing is known of the file.
    """
    try:
        return read_statistical_model(read_content(path), dataset)
    except (FileNotFoundError, ValueError) as error:
        raise ValueError(
            f"{path} is no statistical model of mereo ({error}); delete it and run `mereo generate ... --resume`"
        ) from None


def read_statistical_model(content: bytes, dataset: str | None = None) -> StatisticalModel:
    """Statistical model that a file's content holds; ``ValueError`` (its reason only) where it holds none."""
    tensors, facts = unpack_tensors(content, dataset)
    try:
        return unpack_model(tensors, facts)
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(reason(error)) from None


def with_fewer_modes(model: StatisticalModel, most: int) -> StatisticalModel:
    """The model with its ``most`` largest modes; what the others move counts as residue."""
    if most >= model.count:
        return model
    lost = float((model.motion[most:] ** 2).sum())
    return replace(
        model,
        modes=np.ascontiguousarray(model.modes[..., :most]),
        library=np.ascontiguousarray(model.library[:, :most]),
        residue=float(np.sqrt(model.residue**2 + lost)),
    )


def modes_within(model: StatisticalModel, size: int) -> int:
    """Number of modes that fit into ``size`` bytes; 0 where not even the rest of the model does."""
    tensors, _ = pack_model(model)
    each = 3 * len(model.mean) + len(model.library) + 4
    fixed = sum(value.nbytes for value in tensors.values()) - each * model.count
    return min(model.count, max(0, (size - fixed) // each))


def _integers(
    modes: Float32[ndarray, "m 3 k"], dtype: type[np.signedinteger]
) -> tuple[Int[ndarray, "m 3 k"], Float32[ndarray, " k"]]:
    """Modes in steps of their largest motion, and the motion that one step of each stands for."""
    scale = (np.abs(modes).max(axis=(0, 1), initial=1e-12) / np.iinfo(dtype).max).astype(np.float32)
    return np.rint(modes / scale).astype(dtype), scale


def _narrow(index: ndarray) -> ndarray:
    """Indices in two bytes where they fit."""
    return index.astype(np.uint16 if index.size == 0 or index.max() < 2**16 else np.uint32)


def _rest(tensors: Tensors, facts: Facts) -> SegmentedMesh:
    """The segments at rest."""
    vertices = tensors["vertices"].astype(float)
    faces = tensors["faces"].astype(np.int64)
    first = 0
    start = 0
    segments = []
    for name, color, solid, points, triangles in zip(
        *(facts[key] for key in ("names", "colors", "solid", "vertices", "faces")), strict=True
    ):
        local = faces[start : start + triangles] - first
        segments.append(Segment(name, tuple(color), vertices[first : first + points], local, solid))
        first, start = first + points, start + triangles
    return SegmentedMesh(tuple(segments), tuple((inner, outer) for inner, outer in facts["nested"]))
