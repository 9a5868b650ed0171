"""Make a sample view as those that come with the package, in ``src/mereo/frames``.

    python benchmarks/shipped_frames.py SCENE [--seed 1000000] [--output SCENE.npz]

It is example 0 of a test seed: 16-bit depth, intrinsics and true labels, about 50 kB.
"""

import argparse

import numpy as np

from mereo.geometry.metrics import truth_grid
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

DEPTH_STEP = 0.005
"""Step of the stored depth in scene units, a twentieth of the sensor's noise."""

CELLS = 100


def main() -> None:
    parser = argparse.ArgumentParser(description="Make a sample view of a scene.")
    parser.add_argument("scene")
    parser.add_argument("--seed", type=int, default=TEST_SEED_START)
    parser.add_argument("--output")
    options = parser.parse_args()
    scene = load_scene(options.scene)
    view = sample_view(scene.for_seed(options.seed), GenerateConfig(), example_rng(options.seed, 0))
    camera = view.depth.camera
    truth = truth_grid(view.mesh, CELLS)
    steps = np.rint(view.depth.depth / DEPTH_STEP)
    assert steps.max() <= np.iinfo(np.uint16).max, "the depth is too large for 16 bits"
    np.savez_compressed(
        options.output or f"{scene.name}.npz",
        scene=np.array(scene.name),
        seed=np.array(options.seed),
        depth=steps.astype(np.uint16),
        depth_step=np.array(DEPTH_STEP),
        intrinsics=np.array([camera.focal_x_px, camera.focal_y_px, camera.center_x_px, camera.center_y_px]),
        labels=truth.grid.labels,
        kept=truth.kept,
        origin=truth.grid.origin,
        spacing=truth.grid.spacing,
        names=np.asarray(truth.grid.names),
        unit_m=np.array(np.nan if scene.unit_m is None else scene.unit_m),
    )


if __name__ == "__main__":
    main()
