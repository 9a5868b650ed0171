"""Random states of a scene as material points: what its statistical model is built from."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, UInt8

from mereo.deformation.moving_least_squares import spread
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.io.cores import one_blas_thread
from mereo.io.progress import tracked
from mereo.scenes.principal_components import build_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene, State
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel, material_points

STATES = 1500
STATES_SEED = 500_000
"""A training seed: no test view shares its states."""

LEAST_STATES = 100
"""A small dataset is a trial, which should not wait for 1,500 states."""

NODES = 600
"""Interior material points of all segments together."""

CANDIDATES = 40_000


def interior_nodes(rest: SegmentedMesh) -> tuple[Float[np.ndarray, "j 3"], UInt8[np.ndarray, " j"]]:
    """Points inside the segments, evenly spread, as many for each segment, and their labels."""
    rng = np.random.default_rng(0)
    low, high = rest.bounds
    points = rng.uniform(low, high, size=(CANDIDATES, 3))
    labels = Solids(rest).label(points)
    each = NODES // len(rest.segments)
    rows = [np.empty(0, dtype=np.int64)]
    for label in range(1, len(rest.segments) + 1):
        inside = np.flatnonzero(labels == label)
        if len(inside):
            rows.append(inside[spread(points[inside], each)])
    chosen = np.concatenate(rows)
    return points[chosen], labels[chosen]


def state_points(
    state: State, nodes: Float[np.ndarray, "j 3"], labels: UInt8[np.ndarray, " j"]
) -> Float[np.ndarray, "m 3"]:
    """Positions to which a state has moved all material points, in the scene's frame."""
    moved = np.empty_like(nodes)
    for label in np.unique(labels):
        rows = labels == label
        moved[rows] = state.deformations[label - 1](nodes[rows])
    return material_points(state.mesh, moved)


def sample_states(
    scene: Scene,
    nodes: Float[np.ndarray, "j 3"],
    labels: UInt8[np.ndarray, " j"],
    count: int,
    seed: int,
    quiet: bool = True,
) -> Float32[np.ndarray, "n m 3"]:
    """Material points of random states; state i comes from (seed, i). Progress is shown unless ``quiet``."""
    return np.stack(
        [
            state_points(scene.sample_state(example_rng(seed, i)), nodes, labels).astype(np.float32)
            for i in tracked("model", count, "states", quiet=quiet)
        ]
    )


def built_in_model(name: str, segments: tuple[str, ...]) -> StatisticalModel | None:
    """Statistical model of a built-in scene, where it has these segments; None for other objects."""
    scene = load_scene(name) if name in SCENES else None
    return scene_model(scene) if scene is not None and scene.rest.names == segments else None


def with_frame(model: StatisticalModel, name: str) -> StatisticalModel:
    """The model with the frame of its built-in scene's own files, where it is from before models kept that."""
    if model.source_frame is not None or name not in SCENES:
        return model
    try:
        scene = load_scene(name)
    except AssetUnavailable:
        return model
    return replace(model, source_frame=scene.source_frame) if scene.rest.names == model.rest.names else model


def states_for(examples: int) -> int:
    """Number of states that the model of a dataset is built from: as many as it has examples, within limits."""
    return min(max(examples, LEAST_STATES), STATES)


def scene_model(scene: Scene, count: int = STATES, seed: int = STATES_SEED, *, quiet: bool = True) -> StatisticalModel:
    """Statistical model of a scene, from ``count`` states of a training seed; the same bits on any number of cores.

    The progress of its states is shown unless ``quiet``.
    """
    frame, scene = scene.source_frame, scene.for_seed(seed)
    nodes, labels = interior_nodes(scene.rest)
    states = sample_states(scene, nodes, labels, count, seed, quiet)
    with one_blas_thread():
        model = build_model(scene.rest, nodes, labels, states)
    return replace(model, source_frame=frame)
