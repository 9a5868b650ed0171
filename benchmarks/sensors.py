"""What simulated sensors cost, and what they do to a cloud.

    python benchmarks/sensors.py [SCENE ...] [--views N]

For each sensor: CPU time of a depth image at the paper's size (the least of three rounds over the same views, search
structures built before), the share of object pixels that are left, the share of the cloud that is not the object, and
how far depth is off on object pixels (median of the absolute error, scaled to a normal deviation, in millimetres).
CPU time of whole examples with the paper's sensor is printed for comparison, without and with further observations.
"""

import argparse
import time
from typing import Any

import numpy as np

from mereo.geometry.solids import Solids
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import OBJECT
from mereo.synthesis.config import SENSOR_TERMS, SENSORS, GenerateConfig, SensorConfig
from mereo.synthesis.depth_sensor import observe
from mereo.synthesis.examples import View, sample_view, synthesize

SENSORS_BY_NAME: dict[str, SensorConfig] = dict(
    [*SENSORS.items(), *((name, SensorConfig(**dict[str, Any]({name: 1.0}))) for name in SENSOR_TERMS)]
)
ROUNDS = 3
OBSERVED = GenerateConfig(observations=("all",))


def milliseconds(views: list[tuple[View, Solids]], sensor: SensorConfig) -> float:
    """Of one image."""
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        for index, (view, solids) in enumerate(views):
            observe(solids, view.depth.camera, 0.1, sensor, example_rng(2, index))
        times.append(time.process_time() - start)
    return 1e3 * min(times) / len(views)


def effect(views: list[tuple[View, Solids]], sensor: SensorConfig) -> tuple[float, float, float]:
    """Means over views of the share that is left and the share of strays; the median depth error in millimetres."""
    left, stray, errors = [], [], []
    for index, (view, solids) in enumerate(views):
        seen = observe(solids, view.depth.camera, 0.0, sensor, example_rng(2, index))
        mine = seen.image.valid & (seen.source == OBJECT)
        left.append(mine.sum() / view.depth.valid.sum())
        stray.append(1 - mine.sum() / max(seen.image.valid.sum(), 1))
        both = mine & view.depth.valid
        errors.append(np.abs(seen.image.depth - view.depth.depth)[both] * 1e3 * sensor.metres_per_unit)
    return float(np.mean(left)), float(np.mean(stray)), float(np.median(np.concatenate(errors)) / 0.6745)


def example_milliseconds(scene: Scene, settings: GenerateConfig, count: int) -> float:
    start = time.process_time()
    for index in range(count):
        synthesize(scene, settings, example_rng(1, index))
    return 1e3 * (time.process_time() - start) / count


def measure(name: str, count: int) -> None:
    scene = load_scene(name)
    clean = GenerateConfig(noise_std=0.0)
    views = [(view, Solids(view.mesh)) for view in (sample_view(scene, clean, example_rng(1, i)) for i in range(count))]
    milliseconds(views, SensorConfig())  # builds the search structures
    plain, observed = (example_milliseconds(scene, settings, count) for settings in (GenerateConfig(), OBSERVED))
    print(f"\n{name}: {count} views, {plain:.1f} ms for an example, {observed:.1f} ms with all further observations")
    print(f"{'sensor':20}{'ms':>8}{'left':>8}{'stray':>8}{'off, mm':>10}")
    for sensor_name, sensor in SENSORS_BY_NAME.items():
        left, stray, error = effect(views, sensor)
        print(f"{sensor_name:20}{milliseconds(views, sensor):8.1f}{left:8.2f}{stray:8.3f}{error:10.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="What simulated sensors cost, and what they do to a cloud.")
    parser.add_argument("scenes", nargs="*", default=["rope", "robot", "liver"])
    parser.add_argument("--views", type=int, default=16)
    options = parser.parse_args()
    for scene_name in options.scenes:
        measure(scene_name, options.views)
