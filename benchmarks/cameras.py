"""What a camera's distance, its pixels and its kind do to the answer, on simulated views.

    python benchmarks/cameras.py [SCENE ...] [--views N] [--sensors NAME ...] [--rows N ...]

For each kind of sensor, distance and image size: points in the cloud (median), IoU and mIoU of the network alone and of
the answer (shipped weights, modes), and the share of views that a registration answers. The same states are seen from
the same directions in every row. A scene unit is 5 mm, and the image is 35 degrees wide: twice the distance with twice
the pixels keeps the object's size in pixels. In rows that say "binned", 2 x 2 pixels have become one, their mean.
"""

import argparse
import time
from dataclasses import replace
from functools import partial

import numpy as np

from mereo.fitting.registration.register import registrar_for
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.metrics import intersection_over_union, truth_grid
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo_learning.cases import TestCase
from mereo_learning.scoring import CELLS, score_cases

ROWS = ((0.5, 96, False), (0.5, 192, False), (1.0, 96, False), (1.0, 192, False), (0.5, 192, True), (1.0, 192, True))
"""Distances in metres from the camera to the object's centre, pixels along each side of the image, whether binned."""

SAME_SURFACE = 2.0
"""Scene units (10 mm): pixels of a block that are farther than this from its median are another surface's."""

HEADINGS = {"sensor": 18, "metres": 8, "image": 12, "points": 8, "network": 16, "answer": 16, "registered": 12, "s": 7}


def seen_from(scene: Scene, distance_m: float, metres_per_unit: float) -> Scene:
    """The scene with every camera at one distance."""
    units = distance_m / metres_per_unit
    return replace(scene, workspace=replace(scene.workspace, distance=(units, units)))


def binned(image: DepthImage) -> DepthImage:
    """Image of half the size: each pixel is the mean of those of its four that lie on one surface."""
    height, width = image.depth.shape
    blocks = image.depth.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(height // 2, width // 2, 4)
    measured = np.sort(np.where(blocks > 0, blocks, np.inf), axis=2)
    count = np.isfinite(measured).sum(axis=2)
    median = np.take_along_axis(measured, np.maximum(count - 1, 0)[..., None] // 2, axis=2)
    with np.errstate(invalid="ignore"):  # infinity from infinity, where nothing was measured
        mine = np.isfinite(measured) & (np.abs(measured - median) <= SAME_SURFACE)
    total = np.where(mine, measured, 0.0).sum(axis=2)
    camera = image.camera
    half = (camera.focal_x_px / 2, camera.focal_y_px / 2, camera.center_x_px / 2, camera.center_y_px / 2)
    return DepthImage(total / np.maximum(mine.sum(axis=2), 1), Camera(width // 2, height // 2, *half))


def view_of(scene: Scene, settings: GenerateConfig, bins: bool, index: int) -> TestCase:
    view = sample_view(scene, settings, example_rng(TEST_SEED_START, index))
    image = binned(view.depth) if bins else view.depth
    return TestCase(f"{index}", image.to_points(), truth_grid(view.mesh, CELLS), 1.0)


def line(*cells: str) -> str:
    return "".join(f"{cell:>{width}}" for cell, width in zip(cells, HEADINGS.values(), strict=True))


def measure(name: str, sensors: list[Sensor], rows: list[int], views: int) -> None:
    scene = load_scene(name).for_seed(TEST_SEED_START)
    model = load_model(name)
    print(f"\n{name}: {views} views, seed {TEST_SEED_START}\n{line(*HEADINGS)}")
    for sensor in sensors:
        for distance_m, size, bins in (ROWS[row] for row in rows):
            settings = GenerateConfig(image_size=size, sensor=SENSORS[sensor])
            case = partial(view_of, seen_from(scene, distance_m, settings.sensor.metres_per_unit), settings, bins)
            points = np.median([len(case(index).cloud) for index in range(views)])
            start = time.perf_counter()
            found = score_cases(model, case, views, False, registrar_for(model, "modes", scene))
            seconds = (time.perf_counter() - start) / views
            assert found.network is not None
            network = intersection_over_union(found.network.confusion, model.segmented)
            scores = (f"{score.iou:.3f} / {score.miou:.3f}" for score in (network, found.scores))
            registered = np.mean([source != "network" for source in found.sources])
            where = (sensor, f"{distance_m:g}", f"{size}{' binned' if bins else ''}", f"{points:.0f}")
            print(line(*where, *scores, f"{registered:.2f}", f"{seconds:.1f}"), flush=True)
            print("  mIoU of each view:", " ".join(f"{each.miou:.2f}" for each in found.examples.values()), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="What distance, pixels and kind of a camera do to the answer.")
    parser.add_argument("scenes", nargs="*", default=["liver", "bunny"])
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=list(SENSORS))
    parser.add_argument("--rows", nargs="+", type=int, choices=range(len(ROWS)), default=list(range(len(ROWS))))
    options = parser.parse_args()
    for scene_name in options.scenes:
        measure(scene_name, options.sensors, options.rows, options.views)
