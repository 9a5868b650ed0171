"""What the model of a default deformation answers of states that are not its own: elastic solid against box of rubber.

    python benchmarks/elastic_states.py [SCENES ...] [--views N] [--seed S]

For each built-in scene: views of its own states and of the states of an elastic solid, answered by a search with the
model of its own states, of a box of rubber around the rest mesh, and of an elastic solid. Each row: IoU / mIoU on cells
of a sixtieth, mean of all views; share of the points that are explained; seconds of a search.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mereo.fitting.registration.answer_frame import search_modes
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.scenes.files.deformation_blocks import DeformationBlock, ElasticBlock
from mereo.scenes.files.template import UNPLACED, random_motion, rubber
from mereo.scenes.random_states import OBJECT_STATES, scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view


def variants(scene: Scene) -> dict[str, Scene]:
    """The scene with its own deformations and with the two defaults."""

    def moved_by(blocks: Sequence[DeformationBlock]) -> Scene:
        return replace(scene, sample_deformations=random_motion(scene.rest, tuple(blocks), UNPLACED))

    elastic = ElasticBlock(type="elastic")
    return {"own": scene, "rubber": moved_by(rubber(scene.rest)), "elastic": moved_by([elastic])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["liver", "tumor", "bunny"])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1000)
    arguments = parser.parse_args()
    print("| scene | states | model | IoU / mIoU | explained, % | s |\n|---|---|---|---|---|---|")
    for name in arguments.scenes:
        scenes = variants(load_scene(name))
        models = {kind: scene_model(scene, OBJECT_STATES) for kind, scene in scenes.items()}
        for states in ("own", "elastic"):
            rngs = [example_rng(arguments.seed, index) for index in range(arguments.views)]
            views = [sample_view(scenes[states], GenerateConfig(), rng) for rng in rngs]
            for kind, model in models.items():
                rows = []
                start = time.perf_counter()
                for view in views:
                    cloud = CloudToFit(view.depth.to_points().points, 1.0)
                    fitted = search_modes(cloud, model, Registrar(None, model).config)
                    truth = truth_grid(view.mesh, 60)
                    labels = labels_on(model.mesh(fitted.surface.material), truth.grid)
                    scores = intersection_over_union(grid_confusion(truth, labels, len(model.rest.segments)))
                    rows.append((scores.iou, scores.miou, fitted.registration.explained))
                iou, miou, explained = np.mean(rows, axis=0)
                spent = (time.perf_counter() - start) / len(views)
                row = f"{iou:.3f} / {miou:.3f} | {100 * explained:.1f} | {spent:.1f} |"
                print(f"| {name} | {states} | {kind} | {row}", flush=True)


if __name__ == "__main__":
    main()
