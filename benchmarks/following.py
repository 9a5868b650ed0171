"""What following an object is worth against fitting every frame by itself: latency, jitter, mIoU, recovery.

    python benchmarks/following.py [OBJECT ...] [--seed S] [--seconds 2] [--occluder tool|hand|none] [--every K] \
        [--sensor structured-light|time-of-flight] [--image-size 192] [--noise 0.1] [--noise-end 0.5] [--no-jump]

For each object, with its shipped weights, a sequence at 30 Hz (``synthesis.recording``) from a training seed, seen by a
simulated camera whose Gaussian noise may grow up to ``--noise-end``:

- milliseconds of a tracked frame, median and 90 %, by the clock and of processor time (on a busy machine the first
  says little), and of one fitted by itself by its modes; frames for which the network was asked;
- jitter: standard deviation of a vertex' place over 30 frames of one state that differ by the camera's noise alone (the
  30 before them are left out), and in brackets its way from one of them to the next; root mean squares, scene units;
- mean mIoU over every K-th frame, on a grid of 50^3 cells, tracked and by itself: of all, of those while something is
  in front, and of those afterwards;
- a jump: the sequence goes on with another one's state and camera; frames until the tracked mIoU is within 0.02 of that
  of the frame by itself.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from mereo.fitting.config import TrackConfig
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking import Tracker
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import confusion_matrix, intersection_over_union, truth_grid
from mereo.geometry.solids import label_grid
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.config import SENSORS, Occluder, SequenceConfig
from mereo.synthesis.depth_sensor import add_depth_noise
from mereo.synthesis.recording import Moment, sequence

STILL, SETTLED, BEFORE_JUMP, AFTER_JUMP, CELLS = 60, 30, 10, 12, 50
CLOSE = 0.02
FOREVER_S = 1e9
Frames = list[tuple[float, PointCloud]]


@dataclass(frozen=True, eq=False)
class Run:
    """Tracked answers to frames, and what they took."""

    answers: list[Answer]
    seconds: np.ndarray
    busy_s: np.ndarray

    @classmethod
    def of(cls, registrar: Registrar, frames: Frames, config: TrackConfig) -> "Run":
        tracker, answers, seconds, busy_s = Tracker(registrar, config), [], [], []
        for time_s, cloud in frames:
            started, worked = time.perf_counter(), time.process_time()
            answers.append(tracker.follow(observe(cloud), time_s, scene_unit=1.0))
            seconds.append(time.perf_counter() - started)
            busy_s.append(time.process_time() - worked)
        return cls(answers, np.array(seconds), np.array(busy_s))

    @property
    def asked(self) -> int:
        return sum(not one.tracked for one in self.answers)


def vertices(registration: Registration | None) -> np.ndarray:
    assert registration is not None
    return np.concatenate([segment.vertices for segment in registration.mesh.segments])


def miou(registration: Registration | None, truth: SegmentedMesh) -> float:
    assert registration is not None
    grid = truth_grid(truth, CELLS)
    labels = label_grid(registration.mesh, *grid.grid.axes())
    confusion = confusion_matrix(grid.grid.labels[grid.kept], labels[grid.kept], len(truth.names) + 1)
    return intersection_over_union(confusion, True).miou


def still_frames(scene: Scene, settings: SequenceConfig, options: argparse.Namespace) -> Frames:
    """Frames of one state and place of the camera, which differ by noise alone."""
    settings = replace(
        settings, seconds=STILL / settings.rate, change=FOREVER_S, camera_change=FOREVER_S, occluder="none"
    )
    return frames_of(list(sequence(scene, settings, SENSORS[options.sensor], options.seed)))


def jitter(registrations: list[Registration | None]) -> str:
    places = np.stack([vertices(one) for one in registrations])
    spread = float(np.sqrt(places.var(axis=0).sum(axis=1).mean()))
    return f"{spread:.3f} ({np.sqrt((np.diff(places, axis=0) ** 2).sum(axis=2).mean()):.3f})"


def frames_of(moments: list[Moment], more_noise: float = 0.0) -> Frames:
    """Times and clouds; to the last is added noise of this standard deviation, to those before as much less."""
    rng, last = np.random.default_rng(11), max(len(moments) - 1, 1)
    images = [add_depth_noise(one.seen.image, more_noise * i / last, rng) for i, one in enumerate(moments)]
    return [(one.time_s, image.to_points()) for one, image in zip(moments, images, strict=True)]


def alone(registrar: Registrar, cloud: PointCloud) -> Registration:
    return replace(registrar.fit_modes(CloudToFit(cloud.points, scene_unit=1.0)), rest=None).registration()


def phases(moments: list[Moment], chosen: list[int], hidden: tuple[float, float]) -> Iterator[list[bool]]:
    """Which of the chosen frames belong to the whole, to the time in which something is in front, to that after."""
    times = [moments[i].time_s for i in chosen]
    yield [True for _ in times]
    yield [hidden[0] <= time_s < hidden[1] for time_s in times]
    yield [time_s >= hidden[1] for time_s in times]


def row(name: str, options: argparse.Namespace, config: TrackConfig) -> str:
    registrar, scene = Registrar.of(load_model(name), "modes"), load_scene(name)
    settings = SequenceConfig(
        seconds=options.seconds,
        occluder=options.occluder,
        change=options.change,
        image_size=options.image_size,
        noise_std=options.noise,
    )
    moments = list(sequence(scene, settings, SENSORS[options.sensor], options.seed))
    frames = frames_of(moments, float(np.sqrt(max(options.noise_end**2 - options.noise**2, 0.0))))
    run = Run.of(registrar, frames, config)
    chosen = list(range(0, len(moments), options.every))
    tracked = np.array([miou(run.answers[i].registration, moments[i].mesh) for i in chosen])
    by_itself, spent = [], []
    for i in chosen:
        started = time.process_time()
        found = alone(registrar, frames[i][1])
        spent.append(time.process_time() - started)
        by_itself.append(miou(found, moments[i].mesh))
    scores = [
        f"{tracked[rows].mean():.3f} / {np.array(by_itself)[rows].mean():.3f}"
        for rows in phases(moments, chosen, settings.hidden_s)
    ]
    still = still_frames(scene, settings, options)
    calm = Run.of(registrar, still, config)
    shaken = [alone(registrar, cloud) for _, cloud in still[SETTLED:][: options.shaken]]
    jumped = "-" if options.no_jump else jump(registrar, scene, moments, settings, options, config)
    clock, busy = (np.quantile(1e3 * values, [0.5, 0.9]) for values in (run.seconds, run.busy_s))
    ms = f"{clock[0]:.0f} / {clock[1]:.0f} | {busy[0]:.0f} / {busy[1]:.0f}"
    result = (
        f"| {name} | {ms} | {1e3 * np.median(spent):.0f} | {run.asked} "
        f"| {jitter([one.registration for one in calm.answers[SETTLED:]])} / {jitter(list(shaken))} "
        f"| {' | '.join(scores)} | {jumped} |"
    )
    print(result, flush=True)
    if options.verbose:
        print("  tracked  ", " ".join(f"{value:.2f}" for value in tracked))
        print("  by itself", " ".join(f"{value:.2f}" for value in by_itself))
        print("  asked at ", [round(m.time_s, 2) for m, a in zip(moments, run.answers, strict=True) if not a.tracked])
    return result


def jump(
    registrar: Registrar,
    scene: Scene,
    moments: list[Moment],
    settings: SequenceConfig,
    options: argparse.Namespace,
    config: TrackConfig,
) -> str:
    """Frames after a jump until the track is as good as a frame by itself; "lost" where it is not in time."""
    other = sequence(scene, replace(settings, seconds=1.0, occluder="none"), SENSORS[options.sensor], options.seed + 1)
    before = moments[:BEFORE_JUMP]
    after = [replace(one, time_s=before[-1].time_s + (i + 1) / settings.rate) for i, one in enumerate(other)]
    after = after[:AFTER_JUMP]
    run = Run.of(registrar, frames_of(before + after), config)
    for number, (one, found) in enumerate(zip(after, run.answers[BEFORE_JUMP:], strict=True)):
        if miou(found.registration, one.mesh) >= miou(alone(registrar, one.seen.image.to_points()), one.mesh) - CLOSE:
            return str(number)
    return "lost"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "liver", "rope", "human"])
    for name, value in (("seed", 740_000), ("every", 10), ("image-size", SequenceConfig.image_size), ("shaken", 8)):
        parser.add_argument(f"--{name}", type=int, default=value)
    for name, value in (("seconds", 5.0), ("noise", SequenceConfig.noise_std), ("noise-end", 0.0)):
        parser.add_argument(f"--{name}", type=float, default=value)
    parser.add_argument("--occluder", choices=get_args(Occluder), default="tool")
    parser.add_argument("--sensor", choices=tuple(SENSORS), default="paper")
    parser.add_argument("--change", type=float, default=SequenceConfig.change)
    parser.add_argument("--motion", choices=("pose", "velocity"), default=TrackConfig.motion)
    parser.add_argument("--no-jump", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    config = TrackConfig(motion=options.motion)
    heads = ("object", "ms, 50 / 90 %", "processor ms", "alone", "asked", "jitter, tracked / alone")
    print("|", " | ".join((*heads, "mIoU, tracked / alone", "in front", "after", "jump")), "|")
    print("|---" * (len(heads) + 4) + "|")
    for name in options.objects:
        row(name, options, config)


if __name__ == "__main__":
    main()
