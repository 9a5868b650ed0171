"""A sequence as a folder: frames that `mereo stream` reads, and the truth of each, so that answers can be scored.

    sequence -write_recording-> frames/*.png, camera.json, truth.npz, recording.json -read_recording-> Recording

Frames are depth images in metres with the object cut out, as a camera with a segmentation gives them. The truth holds
the surface itself, so it is read without the scene, and the scene's draws, which play the state again.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError
from scipy.special import ndtr

from mereo.geometry.camera import Camera, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.io.atomic_files import write_json
from mereo.io.config import InputConfig
from mereo.io.errors import SizeError, first_problem, quiet, reason
from mereo.io.intrinsics import written_intrinsics
from mereo.io.readers import read_arrays
from mereo.io.sensor_frame import read_frame
from mereo.scenes.draw_recorder import Call
from mereo.scenes.parameters import Played
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.walks import process_weights, walk
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest, sample_occluder, sample_plane
from mereo.synthesis.config import Sensor, SensorConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.sequence_config import SequenceConfig

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


# --- index ------------------------------------------------------------------------------------------------------------

# What a recorded sequence is of: the content of ``recording.json``, checked when it is read.

INDEX = "recording.json"
"""Name of the file in a recording's folder."""

FORMAT = 1
"""Version of the folder; others are not read."""

MOST_BYTES = 2**24
"""Size above which an index is none: a frame takes 60 bytes."""

Text = Annotated[str, Field(max_length=500)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Level = Annotated[int, Field(ge=0, le=255)]


class _Block(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class RecordedFrame(_Block):
    """Frame of a recording: its file below ``frames``, when it was taken, and how many pixels show the object."""

    file: Annotated[str, Field(pattern=r"^[0-9]{1,9}\.png$")]
    time_s: Annotated[FiniteFloat, Field(ge=0)]
    points: Annotated[int, Field(ge=0)]


class RecordedSegment(_Block):
    """Segment of the recorded object: its name, colour, and whether its faces bound a solid."""

    name: Text
    color: tuple[Level, Level, Level]
    solid: bool


class RecordingIndex(_Block):
    """Content of ``recording.json``.

    Attributes:
        format: version of the folder.
        scene: name or file, as it was given.
        seed: of the sequence.
        rate_hz: frames per second.
        unit_m: metres in a scene unit.
        hidden_s: first and last time at which something may be in front of the object.
        sensor: name of the simulated camera.
        segments: in the order of their labels.
        nested: as in ``SegmentedMesh``.
        frames: in their order.
    """

    format: int
    scene: Text
    seed: Annotated[int, Field(ge=0)]
    rate_hz: Positive
    unit_m: Positive
    hidden_s: tuple[FiniteFloat, FiniteFloat]
    sensor: Text
    segments: Annotated[tuple[RecordedSegment, ...], Field(min_length=1, max_length=254)]
    nested: tuple[tuple[Text, Text], ...]
    frames: Annotated[tuple[RecordedFrame, ...], Field(min_length=1)]

    def check_segments(self) -> None:
        """Raise ``ValueError`` where the segments cannot be those of one object: the mesh knows the rules."""
        nothing, faces = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
        SegmentedMesh(tuple(Segment(s.name, s.color, nothing, faces, s.solid) for s in self.segments), self.nested)


def read_index(path: Path) -> RecordingIndex:
    """Index from its file; raises ``ValueError`` where it is none."""
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    try:
        if len(content) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES // 2**20} MB")
        json.loads(content)
        index = RecordingIndex.model_validate_json(content)
        if index.format != FORMAT:
            raise ValueError(f"its format is {index.format}; this mereo reads format {FORMAT}")
        index.check_segments()
    except ValidationError as error:
        raise ValueError(f"{path} is no recording: {first_problem(error)}: record the sequence again") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no recording ({reason(error)}): record the sequence again") from None
    return index


# --- recording --------------------------------------------------------------------------------------------------------

FRAMES, CAMERA, TRUTH = "frames", "camera.json", "truth.npz"
"""Names in the folder: of the frames' own folder, and of the files beside it."""

FINEST = 10_000.0
"""Largest number of depth steps in a metre."""

LARGEST_PIXEL = 65_535


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded sequence: its frames, and where the object truly is in each.

    Attributes:
        folder: where it is.
        index: what it is of.
        vertices: of all segments, one after the other, camera frame, scene units.
        faces: of these.
        counts: vertices and faces of each segment.
        T_world_camera: pose of the camera in each frame.
        draws: of each state in the order of the calls, as shares; ``sizes`` of the calls tell them apart.
        sizes: numbers of each call.
    """

    folder: Path
    index: RecordingIndex
    vertices: Float[np.ndarray, "n v 3"]
    faces: np.ndarray
    counts: np.ndarray
    T_world_camera: Float[np.ndarray, "n 4 4"]
    draws: Float[np.ndarray, "n d"]
    sizes: np.ndarray

    def __len__(self) -> int:
        return len(self.index.frames)

    @property
    def times_s(self) -> list[float]:
        """Time of each frame."""
        return [frame.time_s for frame in self.index.frames]

    @property
    def reading(self) -> InputConfig:
        """How its frames are read."""
        return InputConfig(intrinsics=self.folder / CAMERA)

    def cloud(self, number: int) -> PointCloud:
        """Points of a frame, camera frame, metres; raises as ``read_frame`` does."""
        return read_frame(self.folder / FRAMES / self.index.frames[number].file, self.reading).cloud

    def truth(self, number: int) -> SegmentedMesh:
        """True segments in a frame, camera frame, metres."""
        return self._rest.with_vertices(self._parts(self.vertices[number].astype(np.float64) * self.index.unit_m))

    @cached_property
    def _rest(self) -> SegmentedMesh:
        faces = np.split(self.faces, np.cumsum(self.counts[:, 1])[:-1])
        first = np.cumsum([0, *self.counts[:-1, 0]])
        segments = tuple(
            Segment(one.name, one.color, vertices, part - start, one.solid)
            for one, vertices, part, start in zip(
                self.index.segments, self._parts(self.vertices[0].astype(np.float64)), faces, first, strict=True
            )
        )
        return SegmentedMesh(segments, self.index.nested)

    def _parts(self, vertices: Float[np.ndarray, "v 3"]) -> list[Float[np.ndarray, "_ 3"]]:
        return np.split(vertices, np.cumsum(self.counts[:, 0])[:-1])


def write_recording(
    folder: Path,
    scene: Scene,
    settings: SequenceConfig,
    sensor: tuple[Sensor, SensorConfig],
    seed: int,
    *,
    named: str = "",
) -> RecordingIndex:
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
    truth, frames, scale, camera = _Truth(), [], FINEST, None
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
        frames.append(RecordedFrame(file=file, time_s=moment.time_s, points=moment.seen.object_points))
        truth.add(moment)
    assert camera is not None
    write_json(folder / CAMERA, {**written_intrinsics(camera), "depth_scale": scale})
    truth.write(folder / TRUTH, scene.rest)
    rest = scene.rest
    index = RecordingIndex(
        format=FORMAT,
        scene=named or scene.name,
        seed=seed,
        rate_hz=float(settings.rate),
        unit_m=float(unit_m),
        hidden_s=settings.hidden_s,
        sensor=sensor[0],
        segments=tuple(RecordedSegment(name=one.name, color=one.color, solid=one.solid) for one in rest.segments),
        nested=rest.nested,
        frames=tuple(frames),
    )
    write_json(folder / INDEX, index.model_dump())
    return index


class _Truth:
    """Truth of a sequence, gathered frame by frame: the pictures themselves would not fit into memory."""

    def __init__(self) -> None:
        self.vertices: list[Float[np.ndarray, "v 3"]] = []
        self.poses: list[Float[np.ndarray, "4 4"]] = []
        self.calls: list[tuple[Call, ...]] = []

    def add(self, moment: Moment) -> None:
        self.vertices.append(np.concatenate([one.vertices for one in moment.mesh.segments]).astype(np.float32))
        self.poses.append(moment.T_world_camera)
        self.calls.append(moment.played.calls)

    def write(self, path: Path, rest: SegmentedMesh) -> None:
        np.savez_compressed(
            path,
            vertices=np.stack(self.vertices),
            faces=rest.merged()[1].astype(np.int32),
            counts=np.array([(len(one.vertices), len(one.faces)) for one in rest.segments]),
            T_world_camera=np.stack(self.poses),
            draws=np.stack([np.concatenate([np.empty(0), *(call.shares for call in calls)]) for calls in self.calls]),
            sizes=np.array([len(call.shares) for call in self.calls[0]], dtype=np.int64),
        )


def is_recording_folder(path: Path) -> bool:
    """Whether a path is a folder that `mereo scene record` wrote."""
    return (path / INDEX).is_file()


def read_recording(path: str | Path) -> Recording:
    """Recording from its folder.

    Raises ``FileNotFoundError`` where there is none, and ``ValueError`` where its files are damaged or do not belong
    together.
    """
    folder = Path(path)
    if not (folder / INDEX).is_file():
        raise FileNotFoundError(f"{folder} has no {INDEX}; `mereo scene record` writes such a folder: check the path")
    index = read_index(folder / INDEX)
    try:
        with quiet():
            arrays = read_arrays(folder / TRUTH)
            kept = {name: arrays[name] for name in Recording.__dataclass_fields__ if name in arrays}
            result = Recording(folder, index, **kept)
            _check(result)
    except SizeError:
        raise
    except Exception as error:  # whatever a damaged archive makes of zlib, tokenize and numpy
        raise ValueError(
            f"{folder / TRUTH} is not the truth of this recording ({reason(error)}); record the sequence again"
        ) from None
    return result


def _check(found: Recording) -> None:
    """Raise ``ValueError`` (its reason only) where arrays have other shapes than the index and each other."""
    frames, segments = len(found), len(found.index.segments)
    vertices = found.vertices
    if vertices.ndim != 3 or vertices.shape[0] != frames or vertices.shape[2] != 3 or vertices.dtype.kind != "f":
        raise ValueError(f"its vertices have the shape {vertices.shape} for {frames} frames")
    if not np.isfinite(vertices).all() or np.abs(vertices).max(initial=0) > 1e12:
        raise ValueError("its vertices are not all finite")
    if found.counts.shape != (segments, 2) or found.counts.dtype.kind != "i" or found.counts.min() < 1:
        raise ValueError(f"it counts other segments than the {segments} of the index")
    if tuple(found.counts.sum(axis=0)) != (vertices.shape[1], len(found.faces)):
        raise ValueError("its counts are not those of its vertices and faces")
    if found.faces.ndim != 2 or found.faces.shape[1] != 3 or found.faces.dtype.kind != "i":
        raise ValueError(f"its faces have the shape {found.faces.shape}")
    last = np.cumsum(found.counts[:, 0])
    owner = np.repeat(np.arange(segments), found.counts[:, 1])[:, None]
    if (found.faces < (last - found.counts[:, 0])[owner]).any() or (found.faces >= last[owner]).any():
        raise ValueError("its faces name vertices that are not there")


def training_seed(seed: int, test: bool) -> int:
    """The seed; raises ``ValueError`` for one for testing that ``test`` does not allow."""
    if seed >= TEST_SEED_START and not test:
        raise ValueError(
            f"the seed is {seed}; seeds from {TEST_SEED_START} up are for testing: take a smaller one, or say --test"
        )
    return seed
