"""A frame to try weights on: a test view of the scene as a point cloud in metres, as `mereo reconstruct` reads it."""

from pathlib import Path

import numpy as np

from mereo.io.writers.ply import write_positions_ply
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

FRAME = "frame.ply"


def write_example_frame(scene: Scene, path: Path) -> str:
    """Write a test view as a PLY file, camera frame; returns what it is, in words with its unit.

    The cloud is in metres, the unit of a file that states none. An object whose size is not known has scene units.
    """
    view = sample_view(scene.for_seed(TEST_SEED_START), GenerateConfig(), example_rng(TEST_SEED_START, 0))
    points = view.depth.to_points().points * (scene.unit_m or 1.0)
    unit = "scene units" if scene.unit_m is None else "metres"
    write_positions_ply(path, points, comment=f"unit: {unit}")
    longest = float(np.ptp(points, axis=0).max())
    return f"a test view of {len(points)} points in {unit}; what is seen is {longest:.3g} {unit} long"
