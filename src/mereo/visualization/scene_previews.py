"""All built-in scenes on one sheet, after the paper's figure of its scenes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.scenes.registry import SCENES, load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.visualization.contact_sheets import Picture, contact_sheet, depth_to_rgb, enlarge, save_png
from mereo.visualization.renderer import Viewpoint, shade

Vector = tuple[float, float, float]

SIZE = 192
"""Width and height of a picture in pixels: two for each pixel of the depth image."""

VIEWS: Mapping[str, tuple[Vector, Vector]] = {
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
"""From where each scene is drawn: viewing direction and up, in the scene's frame."""


def preview_all(path: str | Path, seed: int = 0) -> None:
    """Write one sheet of all built-in scenes: each at rest, in two random states, and the second one's depth image.

    The first three pictures of a scene have one viewpoint and one scale; the depth image is that of a random camera.
    State i comes from (seed, i) alone.

    Raises ``AssetUnavailable`` where a scene's mesh is neither here nor to be had.
    """
    images: list[Picture] = []
    captions: list[str] = []
    for name in SCENES:
        scene = load_scene(name)
        images += scene_row(scene, seed)
        captions += [f"{name}, {len(scene.rest.segments)} segments", "random state", "random state", "its depth image"]
    save_png(path, contact_sheet(images, captions, 8))


def scene_row(scene: Scene, seed: int) -> list[Picture]:
    """The scene at rest and in two random states, from ``VIEWS``, and the depth image of the second state."""
    views = [sample_view(scene, GenerateConfig(), example_rng(seed, index)) for index in (0, 1)]
    meshes = [scene.rest, *(view.mesh.transformed(view.T_world_camera) for view in views)]
    viewpoint = _viewpoint(meshes, *VIEWS[scene.name])
    return [*(shade(mesh, viewpoint, (SIZE, SIZE)) for mesh in meshes), enlarge(depth_to_rgb(views[1].depth), SIZE)]


def _viewpoint(meshes: list[SegmentedMesh], direction: Vector, up: Vector) -> Viewpoint:
    """Orthographic, and just large enough for all meshes."""
    points = np.concatenate([segment.vertices for mesh in meshes for segment in mesh.segments])
    turned = Viewpoint.along(meshes[0].bounds, direction, up).T_view_world
    seen = transform_points(turned, points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    centered = turned.copy()
    centered[:3, 3] -= (low + high) / 2
    return Viewpoint(centered, half_size=1.04 * float((high - low)[:2].max()) / 2)
