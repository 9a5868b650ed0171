"""What following an object is worth against fitting every frame by itself: latency, jitter, mIoU, loss and recovery.

    python benchmarks/following.py [OBJECT ...] [--seed S] [--seconds 5] [--occluder tool|hand|none] [--every K] \
        [--sensor structured-light|time-of-flight] [--image-size 192] [--noise 0.1] [--noise-end 0.5] [--no-events]

For each object, with its shipped weights or none (a scene file, meshes), a sequence at 30 Hz (``synthesis.recording``),
seen by a simulated camera whose Gaussian noise may grow up to ``--noise-end``; `scans` is a real scan of the bunny that
is turned about the line of sight and shifted, with nothing simulated:

- milliseconds of a tracked frame, median and 90 %, by the clock and of processor time (on a busy machine the first
  says little), and of one fitted by itself; frames that the track did not lead to;
- jitter: standard deviation of a vertex' place over 30 frames of one state that differ by the camera's noise alone (the
  30 before them are left out), and in brackets its way from one of them to the next; root mean squares, scene units;
- mean mIoU over every K-th frame, on a grid of 50^3 cells, tracked and by itself: of all, of those while something is
  in front, and of those afterwards;
- a jump: the sequence goes on with another one's state and camera; frames until the tracked mIoU is within 0.02 of that
  of the frame by itself;
- an exchange: another object is there for 6 frames, then the first again, as after a jump; of the frames after the
  second how many are said to show the object, and frames until it is found again. Searches are waited for, which
  otherwise go on in the background.

Test seeds begin at 1,000,000: tune on others.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from mereo.api.objects import load_object
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import find
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking import SynchronousExecutor, Tracker
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import confusion_matrix, intersection_over_union, truth_grid
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.config import SENSORS, Occluder, SequenceConfig
from mereo.synthesis.depth_sensor import add_depth_noise
from mereo.synthesis.recording import sequence
from mereo_learning.scans import SCANS, bunny_posed
from mereo_learning.scoring import trained_scene

STILL, SETTLED, BEFORE, AWAY, AFTER, CELLS = 60, 30, 10, 6, 12, 50
CLOSE = 0.02
FOREVER_S = 1e9


@dataclass(frozen=True, eq=False)
class Shot:
    """Frame of a sequence, with the truth: camera frame and scene units."""

    time_s: float
    cloud: PointCloud
    mesh: SegmentedMesh


Shots = list[Shot]


@dataclass(frozen=True, eq=False)
class Run:
    """Tracked answers to frames, and what they took."""

    answers: list[Answer]
    seconds: np.ndarray
    busy_s: np.ndarray

    @classmethod
    def of(cls, registrar: Registrar, shots: Shots) -> "Run":
        answers, seconds, busy_s = [], [], []
        with Tracker(registrar, executor=SynchronousExecutor()) as tracker:
            for shot in shots:
                started = time.perf_counter()
                worked = time.process_time()
                answers.append(tracker.follow(observe(shot.cloud), shot.time_s, scene_unit=1.0))
                seconds.append(time.perf_counter() - started)
                busy_s.append(time.process_time() - worked)
        return cls(answers, np.array(seconds), np.array(busy_s))


# --- sequences --------------------------------------------------------------------------------------------------------


class SceneShots:
    """Sequences of a scene by a simulated camera."""

    def __init__(self, scene: Scene, options: argparse.Namespace) -> None:
        self.scene, self.sensor, self.noise = scene, SENSORS[options.sensor], (options.noise, options.noise_end)
        self.settings = SequenceConfig(
            seconds=options.seconds,
            occluder=options.occluder,
            image_size=options.image_size,
            noise_std=options.noise,
        )

    def moving(self, seed: int, seconds: float | None = None) -> Shots:
        """A sequence; one of other ``seconds`` has nothing in front and no noise that grows."""
        settings = self.settings if seconds is None else replace(self.settings, seconds=seconds, occluder="none")
        least, most = self.noise
        more = 0.0 if seconds is not None else float(np.sqrt(max(most**2 - least**2, 0.0)))
        return self._shots(settings, seed, more)

    def still(self, seed: int) -> Shots:
        """Frames of one state and place of the camera, which differ by noise alone."""
        settings = replace(self.settings, seconds=STILL / self.settings.rate, change=FOREVER_S, occluder="none")
        return self._shots(replace(settings, camera_change=FOREVER_S), seed)

    def _shots(self, settings: SequenceConfig, seed: int, more_noise: float = 0.0) -> Shots:
        moments = list(sequence(self.scene, settings, self.sensor, seed))
        rng = np.random.default_rng(11)
        last = max(len(moments) - 1, 1)
        images = [add_depth_noise(each.seen.image, more_noise * i / last, rng) for i, each in enumerate(moments)]
        return [Shot(each.time_s, image.to_points(), each.mesh) for each, image in zip(moments, images, strict=True)]


class ScanShots:
    """Real scans of the bunny that are turned about the line of sight and shifted: what is seen stays as it is."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.settings = SequenceConfig(seconds=options.seconds, occluder="none")

    def moving(self, seed: int, seconds: float | None = None) -> Shots:
        """A scan, by the seed, that swings by 40 degrees and a quarter of its length in two seconds."""
        return list(self._shots(seed, self.settings if seconds is None else replace(self.settings, seconds=seconds)))

    def still(self, seed: int) -> Shots:
        """A scan of whose points another half is there in each frame."""
        cloud, mesh = self._posed(seed)
        rng = np.random.default_rng(seed)
        count = len(cloud.points)
        kept = (rng.choice(count, count // 2, replace=False) for _ in range(STILL))
        return [Shot(i / self.settings.rate, PointCloud(cloud.points[rows]), mesh) for i, rows in enumerate(kept)]

    def _posed(self, seed: int) -> tuple[PointCloud, SegmentedMesh]:
        scan = bunny_posed(SCANS[seed % len(SCANS)])
        cloud, mesh, _ = scan.in_camera()
        assert scan.scene_unit is not None
        rows = np.random.default_rng(seed).choice(len(cloud.points), 4000, replace=False)
        return PointCloud(cloud.points[rows] / scan.scene_unit), mesh.transformed(
            np.diag([*[1 / scan.scene_unit] * 3, 1])
        )

    def _shots(self, seed: int, settings: SequenceConfig) -> Iterator[Shot]:
        cloud, mesh = self._posed(seed)
        sight = cloud.points.mean(axis=0)
        size = float(np.ptp(cloud.points, axis=0).max())
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, size=4)
        for i in range(settings.frames):
            T = np.eye(4)
            swing = np.sin(np.pi * i / settings.rate + phase)
            T[:3, :3] = Rotation.from_rotvec(0.35 * swing[0] * sight / np.linalg.norm(sight)).as_matrix()
            T[:3, 3] = 0.125 * size * swing[1:]
            yield Shot(i / settings.rate, PointCloud(transform_points(T, cloud.points)), mesh.transformed(T))


def subject(name: str, options: argparse.Namespace) -> tuple[Registrar, SceneShots | ScanShots]:
    """Registrar of an object, set up, and its sequences."""
    thing = load_object("bunny" if name == "scans" else name)
    registrar = thing.registrar("auto")
    scene = thing.scene
    assert registrar is not None
    registrar.prepare()
    if isinstance(thing.network, Model):
        scene = load_scene(trained_scene(thing.network))
    assert scene is not None
    return registrar, ScanShots(options) if name == "scans" else SceneShots(scene, options)


# --- figures ----------------------------------------------------------------------------------------------------------


def vertices(registration: Registration | None) -> np.ndarray:
    assert registration is not None
    return np.concatenate([segment.vertices for segment in registration.mesh.segments])


def miou(registration: Registration | None, truth: SegmentedMesh) -> float:
    """mIoU of an answer; 0 of a lost object."""
    if registration is None:
        return 0.0
    grid = truth_grid(truth, CELLS)
    labels = label_grid(registration.mesh, *grid.grid.axes())
    confusion = confusion_matrix(grid.grid.labels[grid.kept], labels[grid.kept], len(truth.names) + 1)
    return intersection_over_union(confusion, True).miou


def jitter(registrations: Sequence[Registration | None]) -> str:
    if None in registrations:
        return "lost"
    places = np.stack([vertices(each) for each in registrations])
    spread = float(np.sqrt(places.var(axis=0).sum(axis=1).mean()))
    return f"{spread:.3f} ({np.sqrt((np.diff(places, axis=0) ** 2).sum(axis=2).mean()):.3f})"


def alone(registrar: Registrar, cloud: PointCloud) -> Registration | None:
    candidate = find(observe(cloud), registrar.network, registrar, False, 1.0)
    return None if candidate.modes is None else replace(candidate.modes, rest=None).registration


def phases(times: list[float], hidden: tuple[float, float]) -> Iterator[list[bool]]:
    """Which of the times belong to the whole, to the time in which something is in front, to that after."""
    yield [True for _ in times]
    yield [hidden[0] <= time_s < hidden[1] for time_s in times]
    yield [time_s >= hidden[1] for time_s in times]


def mean_of(values: np.ndarray) -> str:
    return f"{values.mean():.3f}" if len(values) else "-"


def frames_until_found(registrar: Registrar, shots: Shots, answers: Sequence[Answer]) -> str:
    """Frames until the track is as good as a frame by itself; "lost" where it is not in time."""
    for number, (shot, answer) in enumerate(zip(shots, answers, strict=True)):
        if miou(answer.registration, shot.mesh) >= miou(alone(registrar, shot.cloud), shot.mesh) - CLOSE:
            return str(number)
    return "lost"


def events(name: str, registrar: Registrar, source: SceneShots | ScanShots, options: argparse.Namespace) -> str:
    """Frames to a jump, and to the object after it was exchanged, with the other's frames that are believed."""
    pace = 1 / source.settings.rate
    before, after = source.moving(options.seed, 1.0)[:BEFORE], source.moving(options.seed + 1, 1.0)[:AFTER]
    jumped = Run.of(registrar, in_time([*before, *after], pace)).answers[len(before) :]
    other = SceneShots(load_scene("robot" if name != "robot" else "bunny"), options).moving(options.seed, 1.0)[:AWAY]
    exchanged = Run.of(registrar, in_time([*before, *other, *after], pace)).answers[len(before) :]
    away, again = exchanged[:AWAY], exchanged[AWAY:]
    believed = sum(answer.recognition.known is True for answer in away[2:])
    found = [frames_until_found(registrar, after, answers) for answers in (jumped, again)]
    return f"{found[0]} | {believed} of {len(away) - 2}; {found[1]}"


def in_time(shots: Shots, pace: float) -> Shots:
    return [replace(shot, time_s=i * pace) for i, shot in enumerate(shots)]


def row(name: str, options: argparse.Namespace) -> str:
    registrar, source = subject(name, options)
    shots = source.moving(options.seed)
    run = Run.of(registrar, shots)
    chosen = list(range(0, len(shots), options.every))
    tracked = np.array([miou(run.answers[i].registration, shots[i].mesh) for i in chosen])
    by_itself, spent = [], []
    for i in chosen:
        started = time.process_time()
        registration = alone(registrar, shots[i].cloud)
        spent.append(time.process_time() - started)
        by_itself.append(miou(registration, shots[i].mesh))
    times = [shots[i].time_s for i in chosen]
    scores = [
        f"{mean_of(tracked[rows])} / {mean_of(np.array(by_itself)[rows])}"
        for rows in phases(times, source.settings.hidden_s)
    ]
    still = source.still(options.seed)
    calm = Run.of(registrar, still)
    shaken = [alone(registrar, shot.cloud) for shot in still[SETTLED:][:8]]
    clock, busy = (np.quantile(1e3 * values, [0.5, 0.9]) for values in (run.seconds, run.busy_s))
    cells = [
        Path(name).stem,
        f"{clock[0]:.0f} / {clock[1]:.0f}",
        f"{busy[0]:.0f} / {busy[1]:.0f}",
        f"{1e3 * np.median(spent):.0f}",
        str(sum(not answer.tracked for answer in run.answers)),
        f"{jitter([answer.registration for answer in calm.answers[SETTLED:]])} / {jitter(shaken)}",
        *scores,
        "- | -" if options.no_events else events(name, registrar, source, options),
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "liver", "rope", "human", "scans"])
    for name, number in (("seed", 740_000), ("every", 10), ("image-size", SequenceConfig.image_size)):
        parser.add_argument(f"--{name}", type=int, default=number)
    for name, value in (("seconds", 5.0), ("noise", SequenceConfig.noise_std), ("noise-end", 0.0)):
        parser.add_argument(f"--{name}", type=float, default=value)
    parser.add_argument("--occluder", choices=get_args(Occluder), default="tool")
    parser.add_argument("--sensor", choices=tuple(SENSORS), default="paper")
    parser.add_argument("--no-events", action="store_true")
    options = parser.parse_args()
    heads = ["object", "ms, 50 / 90 %", "processor ms", "alone", "not tracked", "jitter, tracked / alone"]
    heads += ["mIoU, tracked / alone", "in front", "after", "frames to a jump", "exchanged: believed; frames"]
    print("|", " | ".join(heads), "|\n" + "|---" * len(heads) + "|")
    for name in options.objects:
        print(row(name, options), flush=True)


if __name__ == "__main__":
    main()
