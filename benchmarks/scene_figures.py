"""Figures that scenes' docstrings state: what tells the robot's fingers apart, what half a cell costs the sheet.

    python benchmarks/scene_figures.py [--views 200]
    python benchmarks/scene_figures.py --picture docs/images/scenes.png

Robot: in how many pixels of a noise-free depth image a random state differs, by more than five times the camera's
noise, from the same with the hand turned by half and its fingers exchanged; views in which the hand shows. Sheet:
scores of the truth against itself, moved by half a cell of its own grid along each axis. The picture shows each
built-in scene at rest, in two random states, these three overlaid, and a depth image of the second.
"""

import argparse

import numpy as np
from jaxtyping import Float

from mereo.deformation.maps import Compose, Rigid
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import confusion_matrix, intersection_over_union, truth_grid
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import inverse_rigid
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.depth_sensor import render_depth
from mereo.synthesis.examples import sample_view
from mereo.visualization.contact_sheets import contact_sheet, depth_to_rgb, enlarge, save_png
from mereo.visualization.renderer import Vector, Viewpoint, shade
from mereo_objects import _robot_parts as parts

TELLING = 0.5
"""Units of depth: five times the camera's noise."""

SHOWN = 10
"""Pixels of hand and fingers, at least; a hand that is hidden is no question."""

SIDE = 192
"""Width and height of a picture: two pixels for each of the depth image."""

VIEWPOINTS: dict[str, tuple[Vector, Vector]] = {
    "human": ((0.3, -0.3, -1.0), (0.0, 1.0, 0.0)),
    "robot": ((0.9, 0.8, -0.45), (0.0, 0.0, 1.0)),
    "bunny": ((0.3, -0.3, -1.0), (0.0, 1.0, 0.0)),
    "lizard": ((0.3, 0.5, -1.0), (0.0, 0.0, 1.0)),
    "rope": ((-0.3, 0.4, -1.0), (-1.0, 0.0, 0.0)),
    "skull": ((0.35, 0.8, -0.6), (1.0, 0.0, 0.0)),
    "engine": ((0.35, 1.0, -0.35), (0.0, 0.0, 1.0)),
    "liver": ((0.25, 0.6, 0.6), (0.0, 1.0, 0.0)),
    "shapes": ((0.5, 1.0, -0.6), (0.0, 0.0, 1.0)),
    "sheet": ((0.3, 0.8, -0.75), (0.0, 0.0, 1.0)),
    "tumor": ((0.25, 0.6, 0.6), (0.0, 1.0, 0.0)),
    "liver-simulated": ((0.25, 0.6, 0.6), (0.0, 1.0, 0.0)),
}
"""Viewing direction and up of each scene's pictures, in the scene's frame."""


def draw_scenes(path: str) -> None:
    """Write the picture of all built-in scenes; states are those of seed 0."""
    images, captions = [], []
    for name, (direction, up) in VIEWPOINTS.items():
        scene = load_scene(name)
        views = [sample_view(scene, GenerateConfig(), example_rng(0, index)) for index in (0, 1)]
        meshes = [scene.rest, *(view.mesh.transformed(view.T_world_camera) for view in views)]
        corners = np.concatenate([each.bounds for each in meshes])
        viewpoint = Viewpoint.along(np.stack([corners.min(axis=0), corners.max(axis=0)]), direction, up)
        states = [shade(mesh, viewpoint, (SIDE, SIDE)) for mesh in meshes]
        overlaid = np.rint(np.mean(np.array(states, dtype=float), axis=0)).astype(np.uint8)
        images += [*states, overlaid, enlarge(depth_to_rgb(views[1].depth), SIDE)]
        words = ("random state", "another", "overlaid", "depth image of the other")
        captions += [f"{name}, {len(scene.rest.segments)} segments", *words]
    save_png(path, contact_sheet(images, captions, 10))


def telling_pixels(views: int) -> Float[np.ndarray, " n"]:
    """Pixels that tell a hand from one turned by half, for each of the views in which it shows."""
    scene = load_scene("robot")
    counts = []
    camera = Camera.from_fov(96, 96, scene.workspace.fov_rad)
    half_turn = Rigid(np.array([np.pi, 0.0, 0.0]), np.zeros(3), np.array(parts.WRIST))
    for index in range(views):
        rng = example_rng(5, index)
        state = scene.sample_state(rng)
        hand, left, right = state.deformations[6:]
        turned = scene.deform(
            (*state.deformations[:6], *(Compose((half_turn, after)) for after in (hand, right, left)))
        )
        T_camera_world = inverse_rigid(scene.workspace.sample(rng, state.mesh.bounds.mean(axis=0)))
        mesh, other = (each.mesh.transformed(T_camera_world) for each in (state, turned))
        seen, confused = (render_depth(each, camera).depth for each in (mesh, other))
        alone = render_depth(SegmentedMesh(mesh.segments[6:]), camera).depth
        if ((alone > 0) & (np.abs(alone - seen) < 1e-3)).sum() >= SHOWN:
            counts.append((np.abs(seen - confused) > TELLING).sum())
    return np.array(counts, dtype=float)


def moved_by_half_a_cell(views: int) -> tuple[float, float]:
    """IoU and mIoU of the sheet's truth on test views, one confusion matrix, against itself moved."""
    scene = load_scene("sheet")
    classes = len(scene.rest.segments) + 1
    confusion = np.zeros((classes, classes), dtype=np.int64)
    for index in range(views):
        view = sample_view(scene, GenerateConfig(), example_rng(TEST_SEED_START, index))
        truth = truth_grid(view.mesh)
        x, y, z = (axis + (axis[1] - axis[0]) / 2 for axis in truth.grid.axes())
        moved = label_grid(view.mesh, x, y, z)
        confusion += confusion_matrix(truth.grid.labels[truth.kept], moved[truth.kept], classes)
    scores = intersection_over_union(confusion)
    return scores.iou, scores.miou


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what scenes' docstrings state.")
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--picture", help="write this picture of all scenes instead")
    options = parser.parse_args()
    if options.picture:
        draw_scenes(options.picture)
        return
    views = options.views
    counts = telling_pixels(views)
    low, median = np.quantile(counts, [0.05, 0.5])
    print(
        f"robot: {len(counts)} views show the hand; {median:g} pixels tell it from one turned by half, {low:g} in 95 %"
    )
    iou, miou = moved_by_half_a_cell(min(views, 64))
    print(f"sheet: truth moved by half a cell along each axis, {min(views, 64)} views: {iou:.3f} / {miou:.3f}")


if __name__ == "__main__":
    main()
