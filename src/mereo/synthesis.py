"""One labelled example: a random state, a random view, labelled query points (paper, section 3.2).

    SegmentedMesh -deform-> -render-> DepthImage -unproject-> PointCloud
                      '---- sample and label query points ---> LabelledPoints

Query boxes are axis-aligned in the camera frame, where the points live, as are the boxes of the evaluation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from mereo.camera import Camera, DepthImage
from mereo.config import GenerateConfig
from mereo.deformation import Deformation, invert
from mereo.frame import Normalizer, inverse_rigid, transform_points
from mereo.mesh import SegmentedMesh
from mereo.ordering import farthest_point_order
from mereo.query_sampling import Samples, sample_queries
from mereo.rendering import add_depth_noise, render_depth
from mereo.scene import Scene
from mereo.solid import Solids, signed_distance_and_direction

MIN_POINTS = 32
ATTEMPTS = 100


@dataclass(frozen=True, eq=False)
class View:
    """A random state seen by a random camera.

    Attributes:
        mesh: the deformed segments in the CAMERA frame.
        depth: the noisy depth image.
        T_world_camera: the camera's pose in the scene's frame.
        deformations: for each segment the map from rest to the scene's frame.
    """

    mesh: SegmentedMesh
    depth: DepthImage
    T_world_camera: Float[np.ndarray, "4 4"]
    deformations: tuple[Deformation, ...]


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Query points with their answers, normalized, in the camera frame.

    Attributes:
        positions, labels: where, and which segment (0 is empty space).
        distances: signed, to the nearest segment surface, negative inside any segment.
        directions: unit vector to that surface.
        rest: rest-pose coordinates of inside points, ``(rest - box centre) / half of the box's longest side`` of the
            joint rest box; NaN outside.
    """

    positions: Float[np.ndarray, "q 3"]
    labels: UInt8[np.ndarray, " q"]
    distances: Float[np.ndarray, " q"]
    directions: Float[np.ndarray, "q 3"]
    rest: Float[np.ndarray, "q 3"]


@dataclass(frozen=True, eq=False)
class Example:
    """What a network learns from.

    Attributes:
        cloud: observed points, normalized, in farthest-point order.
        normalizer: from the observed cloud alone.
        queries: labelled points in the same normalized frame.
    """

    cloud: Float[np.ndarray, "p 3"]
    normalizer: Normalizer
    queries: LabelledPoints


def example_rng(seed: int, index: int) -> np.random.Generator:
    """The generator of example ``index``: any example can be remade alone."""
    return np.random.default_rng(np.random.SeedSequence([seed, index]))


def synthesize(scene: Scene, settings: GenerateConfig, rng: np.random.Generator) -> Example:
    """One training example."""
    view = sample_view(scene, settings, rng)
    points = view.depth.to_points().points
    normalizer = Normalizer.fit(points)
    cloud = normalizer.apply(points)
    solids = Solids(view.mesh)
    samples = sample_queries(solids, settings.sampling, rng)
    return Example(
        cloud=cloud[farthest_point_order(cloud, settings.points)],
        normalizer=normalizer,
        queries=label_queries(scene, view, solids, samples, normalizer),
    )


def sample_view(scene: Scene, settings: GenerateConfig, rng: np.random.Generator) -> View:
    """A random state seen by a random camera; views that see next to nothing are drawn again."""
    camera = Camera.from_fov(settings.image_size, settings.image_size, scene.workspace.fov_rad)
    for _ in range(ATTEMPTS):
        state = scene.sample_state(rng)
        T_world_camera = scene.workspace.sample(rng, state.mesh.bounds.mean(axis=0))
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        depth = add_depth_noise(render_depth(mesh, camera), settings.noise_std, rng)
        if depth.valid.sum() >= MIN_POINTS:
            return View(mesh, depth, T_world_camera, state.deformations)
    raise ValueError(
        f"scene {scene.name!r} showed fewer than {MIN_POINTS} points in {ATTEMPTS} random views; "
        "its camera workspace must see the object: check its distance and field of view"
    )


def label_queries(scene: Scene, view: View, solids: Solids, samples: Samples, normalizer: Normalizer) -> LabelledPoints:
    """Distances, directions and rest coordinates of sampled points, normalized."""
    distance, direction = signed_distance_and_direction(solids, samples.points, samples.labels)
    return LabelledPoints(
        positions=normalizer.apply(samples.points),
        labels=samples.labels,
        distances=distance * normalizer.scale,
        directions=direction,
        rest=rest_coordinates(scene, view, samples),
    )


def rest_coordinates(scene: Scene, view: View, samples: Samples) -> Float[np.ndarray, "q 3"]:
    """Where inside points were before the deformation; the guess is the rest position of the nearest vertex."""
    low, high = scene.rest.bounds
    rest = np.full((len(samples.points), 3), np.nan)
    world = transform_points(view.T_world_camera, samples.points)
    for index, deformation in enumerate(view.deformations):
        members = np.flatnonzero(samples.labels == index + 1)
        if len(members) == 0:
            continue
        moved = transform_points(view.T_world_camera, view.mesh.segments[index].vertices)
        nearest = cKDTree(moved).query(world[members])[1]
        guess = scene.rest.segments[index].vertices[nearest] + world[members] - moved[nearest]
        found, converged = invert(deformation, world[members], guess)
        rest[members[converged]] = found[converged]
    return (rest - (low + high) / 2) / ((high - low).max() / 2)
