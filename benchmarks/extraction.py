"""Coarse-to-fine extraction against the dense grid: points evaluated, seconds, and labels that differ.

    python benchmarks/extraction.py [WEIGHTS] [RESOLUTION] [VIEWS]

Views are test examples of the weights' scene. Where labels differ the two largest logits agree to rounding: a batch of
another size adds in another order.
"""

import sys
import time
from functools import partial

import numpy as np

from mereo.models.weights import load_model
from mereo.reconstruction.isosurfaces import Extraction, extract
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.scoring import trained_scene


def main(weights: str = "rope", resolution: int = 64, views: int = 2) -> None:
    model = load_model(weights)
    scene = load_scene(trained_scene(model)).for_seed(TEST_SEED_START)
    print("view   points asked      share   seconds (coarse to fine, dense)   labels that differ   largest lead there")
    for index in range(views):
        view = sample_view(scene, GenerateConfig(), example_rng(TEST_SEED_START, index))
        field = partial(model.logits, model.encode(view.depth.to_points()))
        low, high = view.mesh.bounds
        box = np.stack([low, high]) + 0.1 * (high - low).max() * np.array([[-1.0], [1.0]])
        results: list[Extraction] = []
        seconds = []
        for every in (False, True):
            start = time.perf_counter()
            results.append(extract(field, box, resolution, model.names, model.colors, dense=every))
            seconds.append(time.perf_counter() - start)
        fine, dense = results
        odd = np.argwhere(fine.grid.labels != dense.grid.labels)
        leads = np.sort(field(dense.grid.positions(odd)), axis=1) if len(odd) else np.zeros((1, 2))
        print(
            f"{index:4d} {fine.evaluated:14d} {fine.evaluated / dense.evaluated:10.1%} "
            f"{seconds[0]:16.2f} {seconds[1]:12.2f} {len(odd):20d} {float((leads[:, -1] - leads[:, -2]).max()):20.2g}"
        )


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(arguments[0] if arguments else "rope", *(int(value) for value in arguments[1:3]))
