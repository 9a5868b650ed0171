"""A sequence as a folder: frames that `mereo stream` reads, and the truth of each, so that answers can be scored.

    sequence -write_recording-> frames/*.png, camera.json, truth.npz, recording.json

Frames are depth images in metres with the object cut out, as a camera with a segmentation gives them. The index
``recording.json`` holds seed, rate, ``unit_m`` (metres in a scene unit), segments, and of each frame its file, its time
and the number of its pixels that show the object. The truth has these arrays, for n frames:

    vertices f32 [n, v, 3]   of all segments, one after the other, in the camera frame, scene units
    faces i32 [f, 3]         of these vertices
    counts [s, 2]            vertices and faces of each segment
    T_world_camera [n, 4, 4] pose of the camera
    draws [n, d], sizes [c]  the scene's draws in the order of its calls, as shares, and the numbers of each call; they
                             play the state again (``scenes.parameters.played_back``)
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.special import ndtr

from mereo.geometry.camera import Camera
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.io.atomic_files import write_json
from mereo.io.intrinsics import written_intrinsics
from mereo.scenes.parameters import Played
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.walks import process_weights, walk
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest, sample_occluder, sample_plane
from mereo.synthesis.config import Sensor, SensorConfig, SequenceConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe

# --- sequences --------------------------------------------------------------------------------------------------------

# Sequences of frames: an object that changes smoothly, seen by a camera that moves smoothly, hidden for a while.
#
#     scene, SequenceConfig, seed -sequence-> Moment (state, camera, what the sensor saw), ...
#
# The object follows a walk through its scene's own states (``scenes.walks``), the camera one through its workspace. A
# tool or a hand comes into view from outside, stays, and leaves. Everything comes from the seed alone.

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
        surroundings = around.at(time_s, solids, T_world_camera)
        seen = observe(solids, camera, settings.noise_std, clear, rng, around=surroundings)
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
    gap: float = 0.0

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
        moved = tuple(Capsule(part.start + shift, part.end + shift, part.radius) for part in self.occluder)
        return Surroundings(moved, background)


def _way_out(occluder: tuple[Capsule, ...], reach: float) -> Float[np.ndarray, "3"]:
    """Shift along the image that takes an occluder out of view, the way its far end lies."""
    if not occluder:
        return np.zeros(3)
    ends = np.stack([end for part in occluder for end in (part.start, part.end)])
    slope = ends[:, :2] / ends[:, 2:]
    outward = slope[np.linalg.norm(slope, axis=1).argmax()]
    outward = outward / np.linalg.norm(outward)
    thickest = max(part.radius for part in occluder)
    # the end that lies farthest back must pass the image's corner
    back = float((reach - slope @ outward).max())
    return np.array([*(outward * (back * ends[:, 2].max() + 2 * thickest)), 0.0])


# --- recording --------------------------------------------------------------------------------------------------------

INDEX, FRAMES, CAMERA, TRUTH = "recording.json", "frames", "camera.json", "truth.npz"
"""Names in a recording's folder, ``FRAMES`` of a folder in it."""

FINEST = 10_000.0
"""Largest number of depth steps in a metre."""

LARGEST_PIXEL = 65_535


def write_recording(
    folder: Path,
    scene: Scene,
    settings: SequenceConfig,
    sensor: tuple[Sensor, SensorConfig],
    seed: int,
    *,
    named: str = "",
) -> None:
    """Write a sequence of a scene into an empty folder.

    Args:
        folder: exists and is empty.
        scene: the object.
        settings: of the sequence.
        sensor: simulated camera, and its name.
        seed: of everything.
        named: how the scene was named; by default by its own name.

    Raises ``ValueError`` as ``sequence`` does.
    """
    unit_m = sensor[1].metres_per_unit if scene.unit_m is None else scene.unit_m
    (folder / FRAMES).mkdir()
    frames, states, scale, camera = [], [], FINEST, None
    digits = max(4, len(str(settings.frames - 1)))
    for number, moment in enumerate(sequence(scene, settings, sensor[1], seed)):
        image = moment.seen.image
        if camera is None:
            farthest = 2 * float(image.depth.max()) * unit_m
            scale = min(FINEST, 10.0 ** np.floor(np.log10(LARGEST_PIXEL / farthest)))
            camera = image.camera
        steps = np.minimum(np.rint(image.depth * unit_m * scale), LARGEST_PIXEL).astype(np.uint16)
        file = f"{number:0{digits}}.png"
        Image.fromarray(steps).save(folder / FRAMES / file)
        frames.append({"file": file, "time_s": moment.time_s, "points": moment.seen.object_points})
        vertices = np.concatenate([segment.vertices for segment in moment.mesh.segments]).astype(np.float32)
        shares = np.concatenate([np.empty(0), *(call.shares for call in moment.played.calls)])
        states.append((vertices, moment.T_world_camera, shares))  # the pictures would not fit into memory
        sizes = [len(call.shares) for call in moment.played.calls]
    assert camera is not None
    write_json(folder / CAMERA, {**written_intrinsics(camera), "depth_scale": scale})
    rest = scene.rest
    vertices, poses, draws = (np.stack(arrays) for arrays in zip(*states, strict=True))
    np.savez_compressed(
        folder / TRUTH,
        vertices=vertices,
        faces=rest.merged()[1].astype(np.int32),
        counts=np.array([(len(segment.vertices), len(segment.faces)) for segment in rest.segments]),
        T_world_camera=poses,
        draws=draws,
        sizes=np.array(sizes, dtype=np.int64),
    )
    index = {
        "format": 1,
        "scene": named or scene.name,
        "seed": seed,
        "rate_hz": float(settings.rate),
        "unit_m": float(unit_m),
        "hidden_s": settings.hidden_s,
        "sensor": sensor[0],
        "segments": [{"name": s.name, "color": s.color, "solid": s.solid} for s in rest.segments],
        "nested": rest.nested,
        "frames": frames,
    }
    write_json(folder / INDEX, index)


def is_recording_folder(path: Path) -> bool:
    """Whether a path is a folder that `mereo scene record` wrote."""
    return (path / INDEX).is_file()


def training_seed(seed: int, test: bool) -> int:
    """The seed; raises ``ValueError`` for one for testing that ``test`` does not allow."""
    if seed >= TEST_SEED_START and not test:
        raise ValueError(
            f"the seed is {seed}; seeds from {TEST_SEED_START} up are for testing: take a smaller one, or say --test"
        )
    return seed
