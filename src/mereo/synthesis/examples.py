"""Labelled examples: a random state, a random view, labelled query points (paper, section 3.2).

    SegmentedMesh -deform-> -render-> DepthImage -unproject-> PointCloud
                      '---- sample and label query points ---> LabelledPoints

Query points are drawn in the camera frame, in boxes whose sides are parallel to the camera's axes. The paper draws them
around the object and then "transforms them into camera space"; drawn there directly, they fill the boxes that
evaluation and reconstruction look into, which know the camera's axes only.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from numpy.random import Generator

from mereo.deformation.maps import Deformations, invert
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.downsampling import farthest_point_order
from mereo.geometry.mesh import SegmentedMesh, barycentric
from mereo.geometry.solids import Nearest, Solids, signed_distance_and_direction
from mereo.geometry.surface_patches import without_strays
from mereo.geometry.transforms import (
    AnyPoints,
    Indices,
    Matrices,
    Normalizer,
    Points,
    Transform,
    inverse_rigid,
    transform_points,
    unit_rows,
)
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.scene import Scene
from mereo.synthesis.clutter import OBJECT
from mereo.synthesis.config import OBSERVATIONS, GenerateConfig, SensorConfig
from mereo.synthesis.depth_sensor import observe
from mereo.synthesis.query_sampling import Samples, sample_queries

QueryPoints = Float[ndarray, "q 3"]
"""Positions or vectors at the query points, in rows."""

ATTEMPTS = 100
"""Number of views drawn before giving up on a scene."""


@dataclass(frozen=True, eq=False)
class View:
    """Random state of a scene, seen by a random camera.

    Attributes:
        mesh: the deformed segments in the CAMERA frame, in scene units.
        depth: the noisy depth image, cut out by the mask, with the camera it was taken with.
        T_world_camera: the camera's pose in the scene's frame.
        deformations: for each segment the map from rest to the scene's frame.
    """

    mesh: SegmentedMesh
    depth: DepthImage
    T_world_camera: Transform
    deformations: Deformations


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Query points with their answers, normalized, in the camera frame.

    Attributes:
        positions, labels: where, and which segment (0 is empty space).
        distances: signed, to the nearest segment surface, negative inside any segment.
        directions: unit vector to that surface.
        rest: rest coordinates (``scenes.rest_pose``) of inside points; NaN outside, and where the deformation could
            not be inverted.
    """

    positions: QueryPoints
    labels: UInt8[ndarray, " q"]
    distances: Float[ndarray, " q"]
    directions: QueryPoints
    rest: QueryPoints


@dataclass(frozen=True, eq=False)
class Example:
    """Observed cloud with labelled queries: what a network learns from.

    Attributes:
        cloud: observed points, normalized, in farthest-point order.
        normalizer: from the observed cloud alone.
        queries: labelled points in the same normalized frame.
        observations: further clouds of the same state and camera in that frame (``synthesis.examples``).
    """

    cloud: Float[ndarray, "p 3"]
    normalizer: Normalizer
    queries: LabelledPoints
    observations: tuple[AnyPoints, ...] = ()


def synthesize(scene: Scene, settings: GenerateConfig, rng: Generator) -> Example:
    """Training example: a random state, seen and noisy, and query points with their answers.

    Raises:
        ValueError: no random view sees the object, or a segment cannot be sampled (``query_sampling``).
    """
    view, solids = _sample_view(scene, settings, rng)
    points = view.depth.to_points().points
    normalizer = Normalizer.fit(points)
    cloud = normalizer.apply(points)
    samples = sample_queries(solids, settings.sampling, rng)
    return Example(
        cloud=cloud[farthest_point_order(cloud, settings.points)],
        normalizer=normalizer,
        queries=_labelled(scene, view, solids, samples, normalizer),
        observations=_further_observations(solids, view.depth, normalizer, settings, rng),
    )


def sample_view(scene: Scene, settings: GenerateConfig, rng: Generator) -> View:
    """Random state of a scene, seen by a random camera.

    Both are drawn again while fewer than ``MIN_POINTS`` points of the object are seen.

    Raises ``ValueError`` naming the scene after ``ATTEMPTS`` such views.
    """
    return _sample_view(scene, settings, rng)[0]


def _sample_view(scene: Scene, settings: GenerateConfig, rng: Generator) -> tuple[View, Solids]:
    """View of a random state, and the search structures on its mesh that rendering has built."""
    workspace = scene.workspace_named(settings.workspace)
    camera = Camera.from_fov(settings.image_size, settings.image_size, workspace.fov_rad)
    for _ in range(ATTEMPTS):
        state = scene.sample_state(rng)
        T_world_camera = workspace.sample(rng, state.mesh.bounds.mean(axis=0))
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        solids = Solids(mesh)
        seen = observe(solids, camera, settings.noise_std, settings.sensor, rng)
        if seen.object_points >= MIN_POINTS:
            return View(mesh, seen.image, T_world_camera, state.deformations), solids
    raise ValueError(
        f"scene {scene.name!r} showed fewer than {MIN_POINTS} points in {ATTEMPTS} random views; "
        "its camera workspace must see the object: check its distance and field of view"
        + (", or weaken the sensor's errors" if settings.sensor.on else "")
    )


def _labelled(scene: Scene, view: View, solids: Solids, samples: Samples, normalizer: Normalizer) -> LabelledPoints:
    """Labels, distances, directions and rest coordinates of sampled points, normalized."""
    nearest = solids.nearest(samples.points)
    distance, direction = signed_distance_and_direction(solids, samples.points, samples.labels, nearest)
    return LabelledPoints(
        positions=normalizer.apply(samples.points),
        labels=samples.labels,
        distances=distance * normalizer.scale,
        directions=direction,
        rest=rest_coordinates(scene, view, samples, nearest),
    )


def rest_coordinates(scene: Scene, view: View, samples: Samples, nearest: Nearest) -> QueryPoints:
    """Rest coordinates of points inside segments, normalized by the joint rest box; NaN for the others."""
    inside = np.flatnonzero(samples.labels)
    world = transform_points(view.T_world_camera, samples.points[inside])
    guess = _rest_guess(scene.rest, view.mesh, samples.points[inside], nearest.point[inside], nearest.face[inside])
    rest = np.full((len(samples.points), 3), np.nan)
    # segments that move together share one deformation and are inverted in one call
    maps = np.array([id(deformation) for deformation in view.deformations])[samples.labels[inside] - 1]
    for deformation in {id(d): d for d in view.deformations}.values():
        members = np.flatnonzero(maps == id(deformation))
        if len(members):
            points, converged = invert(deformation, world[members], guess[members])
            rest[inside[members[converged]]] = points[converged]
    center, half = rest_frame(scene.rest)
    return (rest - center) / half


def _rest_guess(
    rest: SegmentedMesh,
    deformed: SegmentedMesh,
    points: Points,
    closest: Points,
    face: Indices,
) -> Points:
    """First guess of rest positions: the closest surface point's, and the offset from it turned as its triangle was.

    ``closest`` lies on ``face`` of ``deformed.merged()``. The interface of two neighbours is the same in both, so it
    does not matter whose face it is.
    """
    before, faces, _ = rest.merged()
    old, new = before[faces[face]], deformed.merged()[0][faces[face]]
    weights = barycentric(new, closest)
    local = np.einsum("nji,nj->ni", _triangle_frames(new), points - closest)
    return np.einsum("nk,nkj->nj", weights, old) + np.einsum("nij,nj->ni", _triangle_frames(old), local)


def _triangle_frames(triangles: Matrices) -> Matrices:
    """Rotations whose columns are each triangle's first edge, its normal, and the direction across."""
    along = triangles[:, 1] - triangles[:, 0]
    normal = np.cross(along, triangles[:, 2] - triangles[:, 0])
    along, normal = (unit_rows(vectors) for vectors in (along, normal))
    return np.stack([along, normal, np.cross(along, normal)], axis=2)


# --- further observations ---------------------------------------------------------------------------------------------

# Training sees a random one of them, so a network learns what cameras, tools and masks do to a cloud. In use a network
# sees a cloud in up to three ways: with its strays; without those that the rule of ``surface_patches`` finds, which on
# thin objects takes more than strays; and, once a fit knows where the object is, with little but the object's points.
# So each observation is read in one of these ways.

UNCLEANED, BY_RULE = 0.1, 0.4
"""Probabilities that an observation keeps its strays and that it loses those that the rule finds; else it loses all."""

Clouds = tuple[AnyPoints, ...]


def _further_observations(
    solids: Solids, first: DepthImage, normalizer: Normalizer, settings: GenerateConfig, rng: Generator
) -> Clouds:
    """Clouds of the sensors ``settings.further``, normalized as the first one, each in farthest-point order.

    Each is drawn from a stream of its own that is spawned from ``rng``, so what is drawn from ``rng`` stays the same
    with any of them. One that shows fewer than ``MIN_POINTS`` points of the object is the first cloud instead.
    """
    if not settings.further:
        return ()
    streams = dict(zip(OBSERVATIONS, rng.spawn(len(OBSERVATIONS)), strict=True))
    clouds = []
    for name, sensor in settings.further.items():
        points = _observed_points(solids, first, settings.noise_std, sensor, streams[name])
        cloud = normalizer.apply(first.to_points().points if points is None else points)
        clouds.append(cloud[farthest_point_order(cloud, settings.points)])
    return tuple(clouds)


def _observed_points(
    solids: Solids, first: DepthImage, noise_std: float, sensor: SensorConfig, rng: Generator
) -> Points | None:
    """Points that a sensor sees in place of ``first``, in the camera frame; None where too few show the object."""
    way = rng.random()
    seen = observe(solids, first.camera, noise_std, sensor, rng)
    if seen.object_points < MIN_POINTS:
        return None
    points = seen.image.to_points().points
    shows_object = (seen.source == OBJECT)[seen.image.valid]
    if way < UNCLEANED:
        return points
    keep = without_strays(points) if way < UNCLEANED + BY_RULE else shows_object
    return points[keep] if (keep & shows_object).sum() >= MIN_POINTS else None
