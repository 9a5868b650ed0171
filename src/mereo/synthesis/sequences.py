"""Sequences of frames: an object that changes smoothly, seen by a camera that moves smoothly, hidden for a while.

    scene, SequenceConfig, seed -sequence-> Moment (state, camera, what the sensor saw), ...

The object follows a walk through its scene's own states (``scenes.walks``), the camera one through its workspace. A
tool or a hand comes into view from outside, stays, and leaves. Everything comes from the seed alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from mereo.geometry.camera import Camera
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.scenes.parameters import Played
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.scenes.walks import process_weights, walk
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest, sample_occluder, sample_plane
from mereo.synthesis.config import SensorConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.sequence_config import SequenceConfig

ARRIVAL = 0.25
"""Share of its time in view in which an occluder arrives, and in which it leaves."""

CAMERA_REACH, CAMERA_TURN_RAD = 0.35, 0.35
"""How far the camera strays from its first place: the share of its tilt and distance, as normal numbers, that changes;
the standard deviation of its way around the object."""


@dataclass(frozen=True, eq=False)
class Moment:
    """Moment of a sequence.

    Attributes:
        time_s: from the first frame on.
        played: the draws of the object's state.
        mesh: the segments in the camera frame, scene units.
        T_world_camera: pose of the camera in the scene's frame.
        seen: what the sensor saw.
    """

    time_s: float
    played: Played
    mesh: SegmentedMesh
    T_world_camera: Float[np.ndarray, "4 4"]
    seen: SimulatedView


@dataclass(frozen=True, eq=False)
class _Place:
    """Place of the camera, in the terms of the scene's ``Workspace``."""

    cosine: float
    azimuth_rad: float
    distance: float
    roll_rad: float

    def pose(self, scene: Scene, target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
        return scene.workspace.pose(target, self.cosine, self.azimuth_rad, self.distance, self.roll_rad)


def sequence(scene: Scene, settings: SequenceConfig, sensor: SensorConfig, seed: int) -> Iterator[Moment]:
    """Frames of an object that follows a walk through its states.

    Args:
        scene: the object; ``seed`` decides between its states for training and for testing.
        settings: of the sequence.
        sensor: simulated camera. Its own tools and hands are left out for those of ``settings``; its plane stays where
            it is.
        seed: of walk, camera, occluder and noise.

    Raises ``ValueError`` as ``walk`` does, and where the camera sees too little of the object in the first frame.
    """
    scene = scene.for_seed(seed)
    times = np.arange(settings.frames) / settings.rate
    states = walk(scene, seed, times, settings.change)
    places = _camera_places(scene, times / settings.camera_change, example_rng(seed, 2))
    camera = Camera.from_fov(settings.image_size, settings.image_size, scene.workspace.fov_rad)
    rng, clear = example_rng(seed, 3), replace(sensor, tool=0.0, hand=0.0)
    meshes = (scene.deform(played.deformations).mesh for played in states)
    around: _Around | None = None
    for time_s, played, place, mesh in zip(times, states, places, meshes, strict=True):
        T_world_camera = place.pose(scene, mesh.bounds.mean(axis=0))
        mesh = mesh.transformed(inverse_rigid(T_world_camera))
        solids = Solids(mesh)
        if around is None:
            around = _Around.of(solids, camera, T_world_camera, settings, sensor, example_rng(seed, 4))
        there = around.at(time_s, solids, T_world_camera)
        seen = observe(solids, camera, settings.noise_std, clear, rng, around=there)
        yield Moment(float(time_s), played, mesh, T_world_camera, seen)


def _camera_places(scene: Scene, times: Float[np.ndarray, " n"], rng: np.random.Generator) -> list[_Place]:
    """Places on a smooth way near a random one; ``times`` are in units of the change."""
    workspace = scene.workspace
    weights = process_weights(times)
    first = rng.normal(size=3)
    z = weights @ rng.normal(size=(weights.shape[1], 3))
    mixed = ndtr(np.sqrt(1 - CAMERA_REACH**2) * first[:2] + CAMERA_REACH * z[:, :2])
    lowest = np.cos(min(workspace.aperture_rad / 2, np.pi))
    cosine, (near, far) = lowest + mixed[:, 0] * (1 - lowest), workspace.distance
    azimuth = 2 * np.pi * ndtr(first[2]) + CAMERA_TURN_RAD * z[:, 2]
    roll = rng.uniform(0.0, 2 * np.pi) if workspace.any_roll else 0.0
    return [
        _Place(float(c), float(a), float(near + d * (far - near)), roll)
        for c, a, d in zip(cosine, azimuth, mixed[:, 1], strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Around:
    """What stands around an object in a sequence: a plane that stays, and what passes in front of it.

    Attributes:
        occluder: at its place in the middle of its time, camera frame.
        away: shift by which it is out of view.
        span_s: first and last time at which it may be in view.
        normal, gap: of the plane, in the scene's frame, and its distance behind the object; None without one.
    """

    occluder: tuple[Capsule, ...]
    away: Float[np.ndarray, "3"]
    span_s: tuple[float, float]
    normal: Float[np.ndarray, "3"] | None = None
    gap: float = field(default=0.0)

    @classmethod
    def of(
        cls,
        solids: Solids,
        camera: Camera,
        T_world_camera: Float[np.ndarray, "4 4"],
        settings: SequenceConfig,
        sensor: SensorConfig,
        rng: np.random.Generator,
    ) -> "_Around":
        """Surroundings as they are drawn for the first frame."""
        directions = camera.directions().reshape(-1, 3)
        distance = solids.first_hit(directions).distance
        hit = np.isfinite(distance)
        if hit.sum() < MIN_POINTS:
            raise ValueError(
                f"the camera sees {hit.sum()} points of the object in the first frame; at least {MIN_POINTS} are "
                "needed: take another --seed"
            )
        seen, unit = directions[hit] * distance[hit, None], 1 / sensor.metres_per_unit
        reach = float(np.linalg.norm(directions[:, :2], axis=1).max())
        occluder = sample_occluder(settings.occluder, seen, reach, unit, rng)
        away = _way_out(occluder, reach)
        if rng.random() >= sensor.background:
            return cls(occluder, away, settings.hidden_s)
        plane = sample_plane(solids, unit, rng)
        gap = plane.offset - farthest(solids, plane.normal)
        return cls(occluder, away, settings.hidden_s, T_world_camera[:3, :3] @ plane.normal, gap)

    def at(self, time_s: float, solids: Solids, T_world_camera: Float[np.ndarray, "4 4"]) -> Surroundings | None:
        """Surroundings at a time; None where there are none."""
        background = None
        if self.normal is not None:
            normal = self.normal @ T_world_camera[:3, :3]
            background = Backdrop(normal, farthest(solids, normal) + self.gap)
        start, end = self.span_s
        if not (self.occluder and start <= time_s < end):
            return None if background is None else Surroundings((), background)
        share = (time_s - start) / (end - start)
        out = 1.0 - min(share, 1.0 - share) / ARRIVAL
        shift = self.away * max(out, 0.0) ** 2
        moved = tuple(Capsule(one.start + shift, one.end + shift, one.radius) for one in self.occluder)
        return Surroundings(moved, background)


def _way_out(occluder: tuple[Capsule, ...], reach: float) -> Float[np.ndarray, "3"]:
    """Shift along the image that takes an occluder out of view, the way its far end lies."""
    if not occluder:
        return np.zeros(3)
    ends = np.stack([end for one in occluder for end in (one.start, one.end)])
    slope = ends[:, :2] / ends[:, 2:]
    outward = slope[np.linalg.norm(slope, axis=1).argmax()]
    outward = outward / np.linalg.norm(outward)
    thickest = max(one.radius for one in occluder)
    # the end that lies farthest back must pass the image's corner
    back = float((reach - slope @ outward).max())
    return np.array([*(outward * (back * ends[:, 2].max() + 2 * thickest)), 0.0])
