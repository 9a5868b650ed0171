"""What a camera's distance, its pixels and its kind do to the answer, on simulated views.

    python benchmarks/cameras.py [SCENE ...] [--views N] [--sensors NAME ...]

For each kind of sensor, distance and image size: points in the cloud (median), IoU and mIoU of the network alone and of
the answer (shipped weights, modes), and the share of views that a registration answers. The same states are seen from
the same directions in every row. A scene unit is 5 mm, and the image is 35 degrees wide: twice the distance with twice
the pixels keeps the object's size in pixels.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from mereo.evaluation.metrics import intersection_over_union
from mereo.evaluation.scoring import evaluate
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view

ROWS = ((0.5, 96), (0.5, 192), (1.0, 96), (1.0, 192))
"""Distances in metres from the camera to the object's centre, and pixels along each side of the image."""

HEADINGS = {"sensor": 18, "metres": 8, "image": 7, "points": 8, "network": 16, "answer": 16, "registered": 12, "s": 7}


def seen_from(scene: Scene, distance_m: float, metres_per_unit: float) -> Scene:
    """The scene with every camera at one distance."""
    units = distance_m / metres_per_unit
    return replace(scene, workspace=replace(scene.workspace, distance=(units, units)))


def line(*cells: str) -> str:
    return "".join(f"{cell:>{width}}" for cell, width in zip(cells, HEADINGS.values(), strict=True))


def measure(name: str, sensors: list[Sensor], views: int) -> None:
    scene, model = load_scene(name), load_model(name)
    print(f"\n{name}: {views} views, seed {TEST_SEED_START}\n{line(*HEADINGS)}")
    for sensor in sensors:
        for distance_m, size in ROWS:
            settings = GenerateConfig(image_size=size, sensor=SENSORS[sensor])
            there = seen_from(scene, distance_m, settings.sensor.metres_per_unit)
            sample = (sample_view(there, settings, example_rng(TEST_SEED_START, i)).depth for i in range(views))
            points = np.median([image.valid.sum() for image in sample])
            start = time.perf_counter()
            found = evaluate(model, there, examples=views, settings=settings, choice="modes")
            seconds = (time.perf_counter() - start) / views
            network = intersection_over_union(found.answers["network"].confusion, model.segmented)
            scores = (f"{score.iou:.3f} / {score.miou:.3f}" for score in (network, found.scores))
            registered = np.mean([source != "network" for source in found.sources])
            where = (sensor, f"{distance_m:g}", f"{size}", f"{points:.0f}")
            print(line(*where, *scores, f"{registered:.2f}", f"{seconds:.1f}"), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="What distance, pixels and kind of a camera do to the answer.")
    parser.add_argument("scenes", nargs="*", default=["liver", "bunny"])
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=list(SENSORS))
    options = parser.parse_args()
    for scene_name in options.scenes:
        measure(scene_name, options.sensors, options.views)
