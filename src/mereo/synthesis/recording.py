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

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import pi
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from PIL import Image
from scipy.special import ndtr, ndtri

from mereo.geometry.camera import Camera
from mereo.geometry.conventions import MIN_POINTS, Range
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Transform, Values, Vector, inverse_rigid, unit_rows
from mereo.io.atomic_files import write_json
from mereo.io.intrinsics import written_intrinsics
from mereo.scenes.draw_recorder import SMOOTH, Key, OutOfDraws, Recorder
from mereo.scenes.parameters import Played, play, random_state, replayed
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest, sample_occluder, sample_plane
from mereo.synthesis.config import Sensor, SensorConfig, SequenceConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe

# --- walks ------------------------------------------------------------------------------------------------------------

# Every number that a scene draws is a standard normal one as ``Phi^-1(share)`` (``scenes.draw_recorder``). A walk lets
# each follow a smooth Gaussian process of mean 0 and variance 1, so that at any time the state is distributed as the
# scene's own random states are, and never leaves their bounds. What has no way between two values stays as it is at the
# start: whole numbers, choices, permutations, and draws on which it depends what else is drawn (``switches``).
# Notation: n times, d numbers, k nodes of the process.

FASTEST = 9.0
"""Halves of the rest box's longest side a second: a vertex that is faster has jumped."""

TRIES, SHRINK_EVERY, SHRINK = 160, 20, 0.75
"""How often a part of a walk that the scene refuses is drawn again; after so many tries the whole walk shrinks towards
its start, which the scene allows, by this factor."""

EXTREMES = (0.02, 0.98)
"""Shares at which a draw shows whether it is a switch."""


def walk(scene: Scene, seed: int, times_s: Values, change_s: float) -> list[Played]:
    """States of a scene along the smooth walk of a seed, at times that rise from 0.

    In ``change_s`` a state becomes about an independent one. ``scene`` is as ``Scene.for_seed`` gives it. Raises
    ``ValueError`` for a scene that refuses nearly all states between its own.
    """
    start = random_state(scene, seed)
    path = _Path.of(scene, start, seed, times_s / change_s)
    states = list[Played]()
    places = list[ndarray]()
    step = np.diff(times_s, prepend=0.0) * FASTEST * rest_frame(scene.rest)[1]
    tries = 0
    while len(states) < len(times_s):
        i = len(states)
        if (state := replayed(scene, seed, path.shares(i))) is not None:
            place = scene.deform(state.deformations).mesh.merged()[0]
            if i == 0 or norm(place - places[-1], axis=1).max() <= max(step[i], 1e-9):
                states.append(state)
                places.append(place)
                continue
        tries += 1
        if tries > TRIES:
            raise ValueError(
                f"the scene {scene.name!r} refuses the states between its own random ones, {TRIES} times in a row of "
                "other ways: try another --seed, or a slower walk with a larger --change"
            )
        kept = path.redraw(i, shrink=tries % SHRINK_EVERY == 0)
        del states[kept:], places[kept:]
    return states


def process_weights(times: Values) -> Float[ndarray, "n k"]:
    """Weights of independent normal nodes at times, in distances between nodes; their squares sum to 1.

    Cubic B-splines: twice continuously differentiable, and a node is forgotten two distances away.
    """
    nodes = np.arange(int(np.ceil(times.max())) + 4) - 1  # up to two before and after
    away = np.abs(times[:, None] - nodes)
    near, far = 2 / 3 - away**2 + away**3 / 2, np.maximum(2 - away, 0.0) ** 3 / 6
    weights = np.where(away < 1, near, far)
    return unit_rows(weights)


def switches(scene: Scene, start: Played) -> set[Key]:
    """Draws on which it depends what else is drawn: a corner that is bent or not."""
    keys = set()
    for call in start.calls:
        if call.kind not in SMOOTH or len(call.shares) > 1:
            continue
        for share in EXTREMES:
            given = {**start.remembered, call.key: np.array([share])}
            recorder = Recorder(start.seed, given, 2 * len(start.calls) + 10)
            whole = False
            with suppress(OutOfDraws, ValueError):
                play(scene, recorder)
                whole = True
            if _draws_others(start.keys, tuple(drawn.key for drawn in recorder.calls), whole):
                keys.add(call.key)
    return keys


def _draws_others(before: tuple[Key, ...], after: tuple[Key, ...], whole: bool) -> bool:
    """Whether other things are drawn than before; ``whole`` is whether a state came out.

    A scene that refuses what it has drawn gives up, or draws once more from places where it has drawn already; neither
    says that it wants anything else.
    """
    differs = (i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b)
    same = next(differs, min(len(before), len(after)))
    if same == len(after):
        return whole and len(after) < len(before)
    return after[same][0] not in {place for place, _ in before[:same]}


@dataclass(eq=False)
class _Path:
    """Values of all draws along a walk, parts of which can be drawn again."""

    start: Played
    moving: list[bool]
    weights: Float[ndarray, "n k"]
    first: Float[ndarray, " d"]
    nodes: Float[ndarray, "k d"]
    rng: Generator
    reach: float = 1.0

    @classmethod
    def of(cls, scene: Scene, start: Played, seed: int, times: Values) -> "_Path":
        fixed = switches(scene, start)
        moving = [call.kind in SMOOTH and call.key not in fixed for call in start.calls]
        parts = [call.shares for call, moves in zip(start.calls, moving, strict=True) if moves]
        first = ndtri(np.concatenate([np.empty(0), *parts]))
        rng = example_rng(seed, 1)
        weights = process_weights(times)
        nodes = rng.normal(size=(weights.shape[1], len(first)))
        # the walk begins at the start: the nodes that count at time 0 agree with it
        nodes += np.outer(weights[0], first - weights[0] @ nodes)
        return cls(start, moving, weights, first, nodes, rng)

    def shares(self, i: int) -> dict[Key, Float[ndarray, " m"]]:
        """Shares of all draws at time i."""
        z = self.weights[i] @ self.nodes
        z = np.sqrt(1 - self.reach**2) * self.first + self.reach * z if self.reach < 1 else z
        result = {}
        at = 0
        for call, moves in zip(self.start.calls, self.moving, strict=True):
            count = len(call.shares)
            result[call.key] = ndtr(z[at : at + count]) if moves else call.shares
            at += count if moves else 0
        return result

    def redraw(self, i: int, shrink: bool) -> int:
        """Draw the nodes again that count most at time i and after; returns how many first states stay as they were."""
        if shrink:
            self.reach *= SHRINK
            return 0
        first = int(self.weights[i].argmax())
        before = self.nodes.copy()
        self.nodes[first:] = self.rng.normal(size=self.nodes[first:].shape)
        weights = self.weights[0, first:]
        if weights.any():
            self.nodes[first:] += np.outer(weights / (weights @ weights), self.first - self.weights[0] @ self.nodes)
        changed = np.flatnonzero((self.nodes != before).any(axis=1))
        return int(np.flatnonzero((self.weights[:, changed] > 0).any(axis=1))[0]) if len(changed) else 0


# --- sequences --------------------------------------------------------------------------------------------------------

# The object follows a walk through its scene's own states , the camera one through its workspace. A
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
    T_world_camera: Transform
    seen: SimulatedView


def sequence(scene: Scene, settings: SequenceConfig, sensor: SensorConfig, seed: int) -> Iterator[Moment]:
    """Frames of an object that follows a walk through its states, for training or for testing as ``seed`` says.

    The sensor's own tools and hands are left out for those of ``settings``; its plane stays where it is.

    Raises ``ValueError`` as ``walk`` does, and where the camera sees too little of the object in the first frame.
    """
    scene = scene.for_seed(seed)
    times = np.arange(settings.frames) / settings.rate
    states = walk(scene, seed, times, settings.change)
    aims = _camera_aims(scene.workspace, times / settings.camera_change, example_rng(seed, 2))
    camera = Camera.from_fov(settings.image_size, settings.image_size, scene.workspace.fov_rad)
    rng = example_rng(seed, 3)
    clear = replace(sensor, tool=0.0, hand=0.0)
    meshes = (scene.deform(played.deformations).mesh for played in states)
    around: _Around | None = None
    for time_s, played, aimed_at, mesh in zip(times, states, aims, meshes, strict=True):
        T_world_camera = aimed_at(mesh.bounds.mean(axis=0))
        mesh = mesh.transformed(inverse_rigid(T_world_camera))
        solids = Solids(mesh)
        if around is None:
            around = _Around.of(solids, camera, T_world_camera, settings, sensor, example_rng(seed, 4))
        surroundings = around.at(time_s, solids, T_world_camera)
        seen = observe(solids, camera, settings.noise_std, clear, rng, around=surroundings)
        yield Moment(float(time_s), played, mesh, T_world_camera, seen)


def _camera_aims(workspace: Workspace, times: Values, rng: Generator) -> list[Callable[[ndarray], ndarray]]:
    """Poses by what they aim at, on a smooth way near a random one; ``times`` are in units of the change."""
    weights = process_weights(times)
    first = rng.normal(size=3)
    z = weights @ rng.normal(size=(weights.shape[1], 3))
    mixed = ndtr(np.sqrt(1 - CAMERA_REACH**2) * first[:2] + CAMERA_REACH * z[:, :2])
    lowest = np.cos(min(workspace.aperture_rad / 2, pi))
    cosine, (near, far) = lowest + mixed[:, 0] * (1 - lowest), workspace.distance
    azimuth = 2 * pi * ndtr(first[2]) + CAMERA_TURN_RAD * z[:, 2]
    roll = rng.uniform(0.0, 2 * pi) if workspace.any_roll else 0.0
    distance = near + mixed[:, 1] * (far - near)
    return [
        partial(workspace.pose, cosine=float(c), azimuth_rad=float(a), distance=float(d), roll_rad=roll)
        for c, a, d in zip(cosine, azimuth, distance, strict=True)
    ]


class _Around(NamedTuple):
    """What stands around an object in a sequence: a plane that stays, and what passes in front of it.

    The occluder is where it is in the middle of its ``span_s``, and out of view by the shift ``away``; the plane's
    normal is in the scene's frame, and its gap the distance behind the object.
    """

    occluder: tuple[Capsule, ...]
    away: Vector
    span_s: Range
    normal: Vector | None = None
    gap: float = 0.0

    @classmethod
    def of(
        cls,
        solids: Solids,
        camera: Camera,
        T_world_camera: Transform,
        settings: SequenceConfig,
        sensor: SensorConfig,
        rng: Generator,
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
        reach = float(norm(directions[:, :2], axis=1).max())
        occluder = sample_occluder(settings.occluder, seen, reach, unit, rng)
        away = _way_out(occluder, reach)
        if rng.random() >= sensor.background:
            return cls(occluder, away, settings.hidden_s)
        plane = sample_plane(solids, unit, rng)
        gap = plane.offset - farthest(solids, plane.normal)
        return cls(occluder, away, settings.hidden_s, T_world_camera[:3, :3] @ plane.normal, gap)

    def at(self, time_s: float, solids: Solids, T_world_camera: Transform) -> Surroundings | None:
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


def _way_out(occluder: tuple[Capsule, ...], reach: float) -> Vector:
    """Shift along the image that takes an occluder out of view, the way its far end lies."""
    if not occluder:
        return np.zeros(3)
    ends = np.stack([end for part in occluder for end in (part.start, part.end)])
    slope = ends[:, :2] / ends[:, 2:]
    outward = slope[norm(slope, axis=1).argmax()]
    outward = outward / norm(outward)
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
    """Write a sequence of a scene, ``named`` otherwise than by its name or not, into an empty folder.

    Raises ``ValueError`` as ``sequence`` does.
    """
    unit_m = sensor[1].metres_per_unit if scene.unit_m is None else scene.unit_m
    (folder / FRAMES).mkdir()
    frames = []
    states = []
    scale = FINEST
    camera = None
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
        vertices = moment.mesh.merged()[0].astype(np.float32)
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
        sizes=np.array(sizes, np.int64),
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
