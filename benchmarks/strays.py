"""How often strays are told from the object, how many are left, and what it costs where there are none.

    python benchmarks/strays.py [SCENES ...] [--views N] [--seed S]

For each sensor, over all scenes: strays of a view (3 units or more off the object's surface); share of views with two
readings; strays left and genuine points lost by the rule alone; how far the longest side of the box is from that of the
genuine points (mean of |log|) with all points, with the better reading and with the first; share of views whose first
reading drops something, and milliseconds of reading one cloud.
"""

import argparse
import time
from typing import get_args

import numpy as np

from mereo.geometry.camera import PointCloud
from mereo.geometry.solids import Solids
from mereo.geometry.surface_patches import surface_points
from mereo.geometry.transforms import longest_side
from mereo.models.weights_place import shipped_names
from mereo.reconstruction.isolation import readings
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view

OFF = 3.0
"""Scene units."""


def measure(scene: Scene, sensor: Sensor, seed: int, index: int) -> list[float]:
    """Figures of one view, in the order of the table."""
    view = sample_view(scene, GenerateConfig(sensor=SENSORS[sensor]), example_rng(seed, index))
    cloud: PointCloud = view.depth.to_points()
    genuine = np.asarray(Solids(view.mesh).nearest(cloud.points).distance) < OFF
    start = time.process_time()
    found = readings(cloud)
    spent = time.process_time() - start
    keep = surface_points(cloud.points)
    side = longest_side(cloud.points[genuine])
    off = [abs(float(np.log(longest_side(reading.cloud.points) / side))) for reading in found]
    everything = abs(float(np.log(longest_side(cloud.points) / side)))
    strays = (~genuine).sum()
    left = (keep & ~genuine).sum()
    lost = (~keep & genuine).mean()
    return [strays, len(found) > 1, left, lost, everything, min(off), off[0], found[0].dropped > 0, 1e3 * spent]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=shipped_names())
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--seed", type=int, default=700_000)
    options = parser.parse_args()
    print("| sensor | views | strays | two readings | left | lost | box, all | better | first | first drops | ms |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    scenes = [load_scene(name).for_seed(options.seed) for name in options.scenes]
    for sensor in get_args(Sensor):
        rows = [measure(scene, sensor, options.seed, i) for scene in scenes for i in range(options.views)]
        a, b, c, d, e, f, g, h, ms = np.mean(rows, axis=0)
        print(
            f"| {sensor} | {len(rows)} | {a:.1f} | {b:.1%} | {c:.1f} | {d:.1%} | {e:.3f} | {f:.3f} | {g:.3f} | {h:.1%} "
            f"| {ms:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
