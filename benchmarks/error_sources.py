"""Where the errors lie: at the side that the camera sees or at the hidden one, and how far rest coordinates are off.

    python benchmarks/error_sources.py [WEIGHTS ...] [--views N] [--cells C] [--dataset DIR]

For each weight set, over the same test views: wrongly occupied or empty cells per cell of the object's surface layer,
near the observed points (within 1.2 cells) and elsewhere. With the dataset that the first weight set was trained on,
over its last 64 examples, also

- the mean error of rest coordinates inside the object, in half-lengths: after the best rigid motion (the truth's own),
  after the network's alignment, and of the template's lookup;
- IoU and mIoU on the queries: of the first 64 examples, which were trained on, of the last, of the last with the best
  rigid motion instead of the network's, and of the last with the mean answer to eight clouds that lack points.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree
from torch import Tensor

from mereo.geometry.metrics import Scores, TruthGrid, confusion_matrix, intersection_over_union, truth_grid
from mereo.models.model import Model
from mereo.models.rigid_alignment import Alignment, fit_rigid
from mereo.models.weights import load_model
from mereo.models.weights_place import shipped_names
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.config import AugmentConfig
from mereo_learning.dataset import Batch, Dataset, Draws, choose_points
from mereo_learning.scoring import predict_grid, trained_scene

NEAR_CELLS = 1.2
HELD_OUT = 64
CLOUDS = 8
FEWER = AugmentConfig(keep_points=(0.6, 0.9))


def near_and_elsewhere(cells: Bool[np.ndarray, "x y z"], truth: TruthGrid, seen: cKDTree) -> tuple[int, int]:
    """How many of the cells are near an observed point, and how many are not."""
    centers = truth.grid.positions(np.argwhere(cells))
    near = int((seen.query(centers)[0] < NEAR_CELLS * truth.grid.spacing.max()).sum()) if len(centers) else 0
    return near, len(centers) - near


def by_side(weights: str, views: int, cells: int) -> str:
    """A row of the first table."""
    model = load_model(weights)
    scene = load_scene(trained_scene(model)).for_seed(TEST_SEED_START)
    wrong, shell = np.zeros(2), np.zeros(2)
    for index in range(views):
        view = sample_view(scene, GenerateConfig(), example_rng(TEST_SEED_START, index))
        cloud = view.depth.to_points()
        truth = truth_grid(view.mesh, cells)
        occupied = truth.grid.labels > 0
        seen = cKDTree(cloud.points)
        found = predict_grid(model, cloud, truth) > 0
        wrong += near_and_elsewhere((found != occupied) & truth.kept, truth, seen)
        shell += near_and_elsewhere(occupied & ~binary_erosion(occupied), truth, seen)
    seen_rate, hidden_rate = wrong / shell
    return f"| {weights} | {seen_rate:.2f} | {hidden_rate:.2f} | {wrong[1] / wrong.sum():.2f} |"


def mean_error(rest: Float[Tensor, "b q 3"], batch: Batch) -> list[float]:
    """Of each example, over the queries inside the object."""
    return (rest - batch.rest).norm(dim=-1).nanmean(dim=1).tolist()


def best_rigid(batch: Batch) -> Alignment:
    """The motion that fits the true rest coordinates best."""
    known = [~rest.isnan().any(dim=-1) for rest in batch.rest]
    fits = [
        fit_rigid(points[inside][None], rest[inside][None])
        for points, rest, inside in zip(batch.positions, batch.rest, known, strict=True)
    ]
    return Alignment(torch.cat([fit.rotation for fit in fits]), torch.cat([fit.shift for fit in fits]))


@torch.no_grad()
def rest_errors(model: Model, data: Dataset) -> dict[str, list[float]]:
    """Errors of each held-out example by what made the rest coordinates."""
    network = model.network
    errors: dict[str, list[float]] = {"best rigid motion": [], "alignment": [], "template": []}
    for index in torch.arange(len(data) - HELD_OUT, len(data)).split(8):
        batch = data.batch(index, network.config.points, 0, AugmentConfig(), Draws.of(0))
        code = network.encode(batch.cloud, batch.viewpoint)
        prediction = network.query(code, batch.positions)
        assert code.alignment is not None and prediction.rest is not None, "needs weights with alignment and template"
        errors["best rigid motion"] += mean_error(best_rigid(batch).apply(batch.positions), batch)
        errors["alignment"] += mean_error(code.alignment.apply(batch.positions), batch)
        errors["template"] += mean_error(prediction.rest, batch)
    return errors


@torch.no_grad()
def query_scores(model: Model, data: Dataset) -> dict[str, Scores]:
    """Scores on stored queries by which examples they are of and what the network is told."""
    network = model.network
    classes = len(model.names) + 1
    last = torch.arange(len(data) - HELD_OUT, len(data))

    def answer(batch: Batch, alignment: Alignment | None = None) -> Float[Tensor, "b q c"]:
        code = network.encode(batch.cloud, batch.viewpoint)
        if alignment is not None:
            encoding = network.encoder(alignment.apply(batch.cloud))
            code = network.decoder.prepare(encoding, batch.cloud, batch.viewpoint, alignment)
        return network.query(code, batch.positions).logits.softmax(dim=-1)

    def averaged(index: Int[Tensor, " b"], batch: Batch) -> Float[Tensor, "b q c"]:
        draws = Draws.of(0)
        stored = data.read(index)
        seen = stored["cloud"], stored["cloud_count"].long()
        clouds = [choose_points(*seen, network.config.points, FEWER, draws) for _ in range(CLOUDS)]
        return torch.stack([answer(replace(batch, cloud=cloud)) for cloud in clouds]).mean(dim=0)

    ways: dict[str, tuple[Tensor, Callable[[Tensor, Batch], Tensor]]] = {
        "trained on": (torch.arange(HELD_OUT), lambda _, batch: answer(batch)),
        "held out": (last, lambda _, batch: answer(batch)),
        "held out, best rigid motion": (last, lambda _, batch: answer(batch, best_rigid(batch))),
        f"held out, mean of {CLOUDS} clouds": (last, averaged),
    }
    found = {}
    for name, (examples, way) in ways.items():
        total = np.zeros((classes, classes), dtype=np.int64)
        for index in examples.split(8):
            batch = data.batch(index, network.config.points, 0, AugmentConfig(), Draws.of(0))
            guess = way(index, batch).argmax(dim=-1)
            total += confusion_matrix(batch.labels.numpy(), guess.numpy(), classes)
        found[name] = intersection_over_union(total)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="*", default=shipped_names())
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--cells", type=int, default=60)
    parser.add_argument("--dataset", type=Path, help="of the first weights")
    options = parser.parse_args()
    print("| weights | wrong per surface cell, seen | hidden | share of errors hidden |\n|---|---|---|---|")
    for name in options.weights:
        print(by_side(name, options.views, options.cells), flush=True)
    if options.dataset:
        model = load_model(options.weights[0])
        data = Dataset.load(options.dataset)
        for name, values in rest_errors(model, data).items():
            print(f"{options.weights[0]}, {name}: mean {np.mean(values):.3f}, median {np.median(values):.3f}")
        for name, scores in query_scores(model, data).items():
            print(f"{options.weights[0]}, queries {name}: IoU {scores.iou:.3f}, mIoU {scores.miou:.3f}")


if __name__ == "__main__":
    main()
