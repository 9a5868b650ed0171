"""Random states of a scene as material points: what its statistical model is built from."""

import hashlib
import os
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from numpy.linalg import eigh
from numpy.random import default_rng

from mereo.deformation.elastic import ElasticSampler, elastic_motion
from mereo.deformation.maps import moved_by
from mereo.deformation.moving_least_squares import spread
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import align_all, fit_rigid, longest_side
from mereo.io.cores import limit_blas_threads
from mereo.io.errors import limited_memory, words_of
from mereo.io.progress import stage, tracked
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.scene import Scene, State
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import (
    WIDER,
    MaterialPoints,
    PairDistances,
    StatisticalModel,
    kept_distances,
    material_points,
    read_statistical_model,
    save_statistical_model,
    statistical_model_bytes,
)

Nodes = Float[ndarray, "j 3"]
"""Positions of the interior nodes, in rows."""

NodeLabels = UInt8[ndarray, " j"]
"""Label of the segment of each."""

StatePoints = Float32[ndarray, "n m 3"]
"""Material points in each random state."""

STATES = 1500
STATES_SEED = 500_000
"""A training seed: no test view shares its states."""

LEAST_STATES = 100
"""A small dataset is a trial, which should not wait for 1,500 states."""

NODES = 600
"""Interior material points of all segments together."""

CANDIDATES = 40_000


def interior_nodes(rest: SegmentedMesh) -> tuple[Nodes, NodeLabels]:
    """Points inside the segments, evenly spread, as many for each segment, and their labels."""
    rng = default_rng(0)
    low, high = rest.bounds
    points = rng.uniform(low, high, size=(CANDIDATES, 3))
    labels = Solids(rest).label(points)
    each = NODES // len(rest.segments)
    rows = [np.empty(0, np.int64)]
    for label in range(1, len(rest.segments) + 1):
        inside = np.flatnonzero(labels == label)
        if len(inside):
            rows.append(inside[spread(points[inside], each)])
    chosen = np.concatenate(rows)
    return points[chosen], labels[chosen]


def state_points(state: State, nodes: Nodes, labels: NodeLabels) -> MaterialPoints:
    """Positions to which a state has moved all material points, in the scene's frame."""
    return material_points(state.mesh, moved_by(nodes, labels - 1, state.deformations))


def sample_states(
    scene: Scene,
    nodes: Nodes,
    labels: NodeLabels,
    count: int,
    seed: int,
    quiet: bool = True,
) -> StatePoints:
    """Material points of random states; state i comes from (seed, i). Progress is shown unless ``quiet``."""
    return np.stack(
        [
            state_points(scene.sample_state(example_rng(seed, i)), nodes, labels).astype(np.float32)
            for i in tracked("model", count, "states", quiet=quiet)
        ]
    )


def states_for(examples: int) -> int:
    """Number of states that the model of a dataset is built from: as many as it has examples, within limits."""
    return min(max(examples, LEAST_STATES), STATES)


def scene_model(scene: Scene, count: int = STATES, seed: int = STATES_SEED, *, quiet: bool = True) -> StatisticalModel:
    """Statistical model of a scene, from ``count`` states of a training seed; the same bits on any number of cores.

    That of one elastic solid has its very modes. The progress of its states is shown unless ``quiet``.
    """
    frame = scene.source_frame
    scene = scene.for_seed(seed)
    nodes, labels = interior_nodes(scene.rest)
    solid = elastic_motion(scene.sample_deformations)
    if solid is not None:
        states = sample_states(scene, nodes, labels, CHECKED, seed, quiet)
        return replace(elastic_model(scene.rest, nodes, labels, solid, states, count), source_frame=frame)
    states = sample_states(scene, nodes, labels, count, seed, quiet)
    with limit_blas_threads():
        model = build_model(scene.rest, nodes, labels, states)
    return replace(model, source_frame=frame)


CHECKED = 20
"""States of an elastic solid whose distance from its linear model is the model's residue."""


def elastic_model(
    rest: SegmentedMesh,
    nodes: Nodes,
    node_labels: NodeLabels,
    solid: ElasticSampler,
    states: StatePoints,
    count: int,
) -> StatisticalModel:
    """Statistical model of an elastic solid: the rest pose, its modes, and ``count`` normal draws as the library.

    The residue is the root mean square distance of ``states``, which bend as the modes do not, from the model.
    """
    points = material_points(rest, nodes)
    flat = WIDER * solid.modes.reshape(len(solid.modes), -1)
    modes = (solid.solid.mesh.embed(points) @ flat).reshape(len(points), 3, -1).astype(np.float32)
    library = default_rng(0).normal(size=(count, modes.shape[2])).astype(np.float32)
    model = StatisticalModel(rest, nodes, node_labels, points, modes, library, 0.0, PairDistances.none())
    model = replace(model, is_normal=True, is_held=solid.held is not None)
    left = []
    for state in states.astype(float):
        T, z = model.project(state)
        left.append(((state - model.material(z) @ T[:3, :3].T - T[:3, 3]) ** 2).sum(axis=1).mean())
    return replace(model, residue=float(np.sqrt(np.mean(left))))


# --- principal components ---------------------------------------------------------------------------------------------

# Building the statistical model of an object from its states: alignment, then principal components.

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
    nodes: Nodes,
    node_labels: NodeLabels,
    states: StatePoints,
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
            f"a statistical model cannot be made of {len(states)} states; it needs 2 or more: record more states"
        )
    held_out = max(1, round(HELD_OUT * len(states)))
    mean, aligned = _aligned(material_points(rest, nodes), states)
    seen, unseen = aligned[:-held_out], aligned[-held_out:]
    _, half = rest_frame(rest)
    library, modes = _principal(seen, most, LEAST_MOTION * half)
    left = unseen - (unseen @ np.linalg.pinv(modes)) @ modes if len(modes) else unseen
    residue = float(np.sqrt((left.astype(float) ** 2).sum() / (left.size / 3)))
    layout = np.ascontiguousarray(modes.reshape(len(modes), len(mean), 3).transpose(1, 2, 0))
    pairs = kept_distances(spread(material_points(rest, nodes), PAIR_POINTS), mean, layout, library, half)
    return StatisticalModel(rest, nodes, node_labels, mean, layout, library, residue, pairs)


def _aligned(rest: MaterialPoints, states: StatePoints) -> tuple[MaterialPoints, Float32[ndarray, "n c"]]:
    """The mean, turned as the rest pose, and the aligned states' differences from it."""
    few = spread(rest, PROCRUSTES_POINTS)
    rotation, center, mean = align_all(states[:, few], PROCRUSTES_ROUNDS, 1e-5 * longest_side(rest))
    T = fit_rigid(mean.astype(float), rest[few])
    rotation = (T[:3, :3] @ rotation).astype(np.float32)
    aligned = np.matmul(states - center[:, None], rotation.transpose(0, 2, 1)) + T[:3, 3].astype(np.float32)
    middle = aligned.mean(axis=0)
    return middle.astype(float), (aligned - middle).reshape(len(states), -1)


def _principal(
    differences: Float32[ndarray, "n c"], most: int, least: float
) -> tuple[Float32[ndarray, "n k"], Float32[ndarray, "k c"]]:
    """Coefficients of the states, of unit variance, and the modes, largest first."""
    count, columns = differences.shape
    few = spread_columns(columns, GRAM_POINTS)
    part = differences[:, few]
    values, vectors = eigh((part @ part.T).astype(float) / len(few) * 3)
    order = np.argsort(values)[::-1][:most]
    order = order[np.sqrt(np.maximum(values[order], 0.0) / count) > least]
    library = (vectors[:, order] * np.sqrt(count)).astype(np.float32)
    return library, library.T @ differences / np.float32(count)


def spread_columns(columns: int, points: int) -> Int[ndarray, " c"]:
    """Columns of about ``points`` evenly chosen material points."""
    step = max(1, columns // 3 // points)
    return (np.arange(0, columns // 3, step)[:, None] * 3 + np.arange(3)).ravel()


# --- models kept in the cache -----------------------------------------------------------------------------------------

# Statistical model of an object without weights: made of its scene's random states in seconds, and kept for later.
#
# Scene -kept_model-> StatisticalModel
#
# The file's name is a digest of all that the model is made from: the rest mesh, the first random states, which change
# with the scene and with the code that deforms it, and the constants. So a file is never out of date, and whoever wants
# the space may delete it. The folder is ``models`` in the user's cache of mereo, or what ``MEREO_CACHE`` names.

CACHE_VARIABLE = "MEREO_CACHE"
"""Environment variable that names another folder than the user's cache."""

OBJECT_STATES = 400
"""States of an object that nothing is trained on: with more, the answers are the same and the wait is longer."""

KEYED_BY = 3
"""States that decide the name of the file."""

VERSION = 1
"""To be raised where the same states give another model."""


class CacheWarning(UserWarning):
    """Warning that something is made each time, because it cannot be kept."""


def kept_model(scene: Scene) -> StatisticalModel:
    """Statistical model of a scene: read where it was made before, else made, and kept for the next time.

    A ``CacheWarning`` says where it cannot be kept.
    """
    path = cache_folder() / "models" / f"{model_key(scene, OBJECT_STATES)}.safetensors"
    with suppress(OSError, ValueError), limited_memory(path):  # not there, or damaged: it is made again
        if path.is_file():  # a pipe would be waited for
            return read_statistical_model(path.read_bytes())
    with stage("make the object's statistical model, once"):
        made = scene_model(scene, OBJECT_STATES)
    try:
        save_statistical_model(made, path)
    except (OSError, ValueError) as error:  # a full disk, a place that cannot be written to, or something else there
        why = words_of(error).rpartition(": ")[0]
        text = (
            f"the object's statistical model cannot be kept ({why}), and is made again each time: name a folder that "
        )
        warnings.warn(f"{text}can be written to with {CACHE_VARIABLE}", CacheWarning, stacklevel=2)
    return read_statistical_model(statistical_model_bytes(made))  # the same bits as from the file


def cache_folder() -> Path:
    """Folder of what mereo keeps for later."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    import pooch

    return Path(pooch.os_cache("mereo"))


def model_key(scene: Scene, count: int) -> str:
    """Digest of all that a scene's model is made from."""
    drawn = scene.for_seed(STATES_SEED)
    digest = hashlib.sha256(f"{VERSION} {count} {STATES_SEED} {NODES} {scene.unit_m} {scene.rest.nested}".encode())
    digest.update((scene.space or "").encode())
    digest.update(np.ascontiguousarray(scene.T_scene_source).tobytes())
    for name, frame in scene.link_frames.items():
        digest.update(name.encode() + np.ascontiguousarray(frame).tobytes())
    for segment in drawn.rest.segments:
        digest.update(f"{segment.name} {segment.color} {segment.solid} {segment.faces.shape}".encode())
        digest.update(np.ascontiguousarray(segment.faces, np.int64).tobytes())
    solid = elastic_motion(drawn.sample_deformations)
    states = () if solid is not None else range(KEYED_BY)  # to draw from a solid takes seconds
    for mesh in (drawn.rest, *(drawn.sample_state(example_rng(STATES_SEED, i)).mesh for i in states)):
        digest.update(np.ascontiguousarray(mesh.merged()[0], float).tobytes())
    if solid is not None:
        digest.update(f"{solid.digest} {solid.motion!r}".encode())
    return digest.hexdigest()[:32]
