"""What isolating the object brings under simulated sensors, and what it costs where nothing is wrong.

    python benchmarks/isolation.py [WEIGHTS ...] [--views N] [--cells C]

For each weight set and sensor: IoU and mIoU over the same test views, with the cloud as it comes and after each way of
isolation; the share of the cloud that is kept, on average and at worst; CPU milliseconds of isolating one cloud.
"""

import argparse
import time

import numpy as np

from mereo.geometry.metrics import grid_confusion, intersection_over_union, truth_grid
from mereo.models.weights import load_model
from mereo.models.weights_place import shipped_names
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object, observe
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo_learning.scoring import predict_grid, trained_scene

WAYS = {
    "as it comes": IsolationConfig(),
    "outliers": IsolationConfig(remove_outliers=True),
    "largest cluster": IsolationConfig(largest_cluster=True),
    "both": IsolationConfig(remove_outliers=True, largest_cluster=True),
}


def measure(weights: str, sensor: Sensor, views: int, cells: int) -> None:
    """Print a row of the table for each way."""
    model = load_model(weights)
    scene = load_scene(trained_scene(model)).for_seed(TEST_SEED_START)
    confusion = {way: np.zeros((len(model.names) + 1,) * 2, dtype=np.int64) for way in WAYS}
    kept: dict[str, list[float]] = {way: [] for way in WAYS}
    spent = dict.fromkeys(WAYS, 0.0)
    for index in range(views):
        settings = GenerateConfig(sensor=SENSORS[sensor])
        view = sample_view(scene, settings, example_rng(TEST_SEED_START, index))
        cloud = view.depth.to_points()
        truth = truth_grid(view.mesh, cells)
        for way, config in WAYS.items():
            start = time.process_time()
            left = find_object(observe(cloud).frame, config).cloud
            spent[way] += time.process_time() - start
            kept[way].append(len(left) / len(cloud))
            confusion[way] += grid_confusion(truth, predict_grid(model, left, truth), len(model.names))
    for way, matrix in confusion.items():
        scores = intersection_over_union(matrix, model.segmented)
        share = f"{np.mean(kept[way]):.3f} ({min(kept[way]):.3f})"
        print(
            f"| {weights} | {sensor} | {way} | {scores.iou:.3f} | {scores.miou:.3f} | {share} "
            f"| {1e3 * spent[way] / views:.1f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="*", default=shipped_names())
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--cells", type=int, default=32)
    options = parser.parse_args()
    print("| weights | sensor | isolation | IoU | mIoU | kept (least) | ms |\n|---|---|---|---|---|---|---|")
    for weights in options.weights:
        for sensor in SENSORS:
            measure(weights, sensor, options.views, options.cells)


if __name__ == "__main__":
    main()
