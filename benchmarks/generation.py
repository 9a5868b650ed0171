"""How fast complete examples are made, against a straightforward implementation with trimesh and embreex.

    python benchmarks/generation.py [SCENE ...] [--examples N]

Both make the same thing at the paper's settings: a random state seen by a random camera, a noisy depth image,
SortSample queries with labels, signed distances and directions. The rival uses trimesh's own functions, as its
documentation suggests: the Embree intersector for the image (`pip install embreex`), ``contains`` for labels,
``closest_point`` for distances.
It may skip what trimesh has nothing for, the rest coordinates and the farthest-point order; ours makes them too.

Both run in this process, one example of each in turn, so that a busy machine slows both. Times are medians, of seconds
of the clock and of seconds of CPU; the latter say what one core does on an idle machine. Last, what each stage of ours
takes.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Normalizer, inverse_rigid
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis import examples, query_sampling
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import synthesize

SETTINGS = GenerateConfig()


# --- the rival --------------------------------------------------------------------------------------------------------


def rival_example(scene: Scene, settings: GenerateConfig, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """One example as one would write it with trimesh at hand."""
    state = scene.sample_state(rng)
    T_world_camera = scene.workspace.sample(rng, state.mesh.bounds.mean(axis=0))
    segments = state.mesh.transformed(inverse_rigid(T_world_camera)).segments
    parts = [trimesh.Trimesh(s.vertices, s.faces, process=False) for s in segments]
    vertices, faces, _ = SegmentedMesh(segments).merged()
    whole = trimesh.Trimesh(vertices, faces, process=False)
    cloud = rival_cloud(whole, Camera.from_fov(settings.image_size, settings.image_size, scene.workspace.fov_rad), rng)
    points = np.concatenate([rival_sort_sample(parts, index, rng) for index in range(len(parts))])
    low, high = whole.bounds
    extra = settings.sampling.total(len(parts)) - len(points)
    points = np.concatenate([points, rng.uniform(low, high, size=(extra, 3))])
    labels = rival_labels(parts, points)
    foot, distance, _ = trimesh.proximity.closest_point(whole, points)
    direction = (foot - points) / np.maximum(distance, 1e-12)[:, None]
    normalizer = Normalizer.fit(cloud)
    signed = np.where(labels > 0, -distance, distance) * normalizer.scale
    return normalizer.apply(cloud), normalizer.apply(points), labels, signed, direction


def rival_cloud(whole: trimesh.Trimesh, camera: Camera, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    rays = camera.directions().reshape(-1, 3)
    places, ray, _ = whole.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    noise = rng.normal(0.0, SETTINGS.noise_std, size=len(places))
    noisy: Float[np.ndarray, "n 3"] = places + noise[:, None] * rays[ray]
    return noisy


def rival_labels(parts: list[trimesh.Trimesh], points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    labels = np.zeros(len(points), dtype=np.uint8)
    for index, part in reversed(list(enumerate(parts))):
        labels[part.contains(points)] = index + 1
    return labels


def rival_sort_sample(
    parts: list[trimesh.Trimesh], index: int, rng: np.random.Generator, batch: int = 1024
) -> Float[np.ndarray, "n 3"]:
    """Draw until both sides hold n, then keep the k nearest of each."""
    sampling = SETTINGS.sampling
    keep = sampling.per_segment // 2
    low, high = parts[index].bounds
    reach = (high - low) * sampling.box_margin / 2
    points, labels = np.empty((0, 3)), np.empty(0, dtype=np.uint8)
    while min((labels == index + 1).sum(), (labels == 0).sum()) < keep * sampling.oversample:
        drawn = rng.uniform(low - reach, high + reach, size=(batch, 3))
        points, labels = np.concatenate([points, drawn]), np.concatenate([labels, rival_labels(parts, drawn)])
    kept = []
    for label in (index + 1, 0):
        side = points[labels == label]
        _, distance, _ = trimesh.proximity.closest_point(parts[index], side)
        kept.append(side[np.argsort(distance)[:keep]])
    return np.concatenate(kept)


# --- measuring --------------------------------------------------------------------------------------------------------


def seconds(function: Callable[[], Any]) -> tuple[float, float]:
    """Of the clock, of the CPU."""
    clock = time.perf_counter()
    cpu = time.process_time()
    function()
    return time.perf_counter() - clock, time.process_time() - cpu


def compare(scene: Scene, examples: int) -> None:
    synthesize(scene, SETTINGS, example_rng(0, 0))  # first use loads and caches
    rival_example(scene, SETTINGS, example_rng(0, 0))
    ours, rival = [], []
    for index in range(examples):
        ours.append(seconds(partial(synthesize, scene, SETTINGS, example_rng(1, index))))
        rival.append(seconds(partial(rival_example, scene, SETTINGS, example_rng(1, index))))
    parts = len(scene.rest.segments)
    print(
        f"\n{scene.name}: {parts} segments, {sum(len(s.faces) for s in scene.rest.segments)} faces, {examples} examples"
    )
    print(f"{'':8}{'ours/s':>10}{'rival/s':>10}{'ratio':>8}")
    for number, kind in enumerate(("clock", "CPU")):
        mine, theirs = (median(row[number] for row in rows) for rows in (ours, rival))
        print(f"{kind:8}{1 / mine:10.1f}{1 / theirs:10.2f}{theirs / mine:8.1f}")


STAGES: tuple[tuple[Any, str, str], ...] = (
    (examples, "_sample_view", "view"),
    (Scene, "sample_state", "view: state"),
    (examples, "observe", "view: depth image"),
    (examples, "sample_queries", "sampling"),
    (Solids, "label", "sampling: labels"),
    (query_sampling, "_nearest_rows", "sampling: k nearest"),
    (Solids, "nearest", "distances and directions"),
    (examples, "rest_coordinates", "rest coordinates"),
    (examples, "farthest_point_order", "farthest-point order"),
    (examples, "synthesize", "whole example"),
)


def profile(scene: Scene, count: int) -> None:
    """CPU time of each stage, by wrapping its function; "a: b" is a part of a."""
    spent: dict[str, float] = defaultdict(float)

    def timed(function: Callable[..., Any], name: str) -> Callable[..., Any]:
        def wrapped(*values: Any, **named: Any) -> Any:
            start = time.process_time()
            try:
                return function(*values, **named)
            finally:
                spent[name] += time.process_time() - start

        return wrapped

    originals = [(owner, attribute, getattr(owner, attribute)) for owner, attribute, _ in STAGES]
    try:
        for owner, attribute, name in STAGES:
            setattr(owner, attribute, timed(getattr(owner, attribute), name))
        for index in range(count):
            examples.synthesize(scene, SETTINGS, example_rng(1, index))
    finally:
        for owner, attribute, original in originals:
            setattr(owner, attribute, original)
    for *_, name in STAGES:
        print(f"  {name:26}{1e3 * spent[name] / count:7.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", default=["bunny", "rope"])
    parser.add_argument("--examples", type=int, default=10)
    options = parser.parse_args()
    for name in options.scenes:
        scene = load_scene(name)
        compare(scene, options.examples)
        profile(scene, options.examples)


if __name__ == "__main__":
    main()
