"""Clouds of what no scene shows: planes, and heaps of boxes, balls and cylinders.

For trials of what is said of a frame that does not show the object. They are as large as the object and seen by the
same camera, so that size and noise tell nothing.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.geometry.camera import Camera, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.scenes.scene import Scene
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.depth_sensor import observe

Stranger = Literal["plane", "clutter"]

FEWEST, MOST = 3, 8
"""Bodies in a heap."""

STEEPEST_RAD = 1.2
"""Largest angle between a plane's normal and the line of sight."""


def stranger_cloud(scene: Scene, kind: Stranger, settings: GenerateConfig, rng: np.random.Generator) -> PointCloud:
    """Cloud of a plane or a heap, about as large as a scene's object, by a camera as far away as the scene's."""
    workspace = scene.workspace_named(settings.workspace)
    camera = Camera.from_fov(settings.image_size, settings.image_size, workspace.fov_rad)
    low, high = scene.rest.bounds
    size = float((high - low).max())
    while True:
        middle = np.array([0.0, 0.0, rng.uniform(*workspace.distance)])
        bodies = [_plate(size, rng)] if kind == "plane" else _heap(size, rng)
        parts = tuple(
            Segment(
                f"body {i + 1}", PALETTE[i % len(PALETTE)], np.asarray(body.vertices) + middle, np.asarray(body.faces)
            )
            for i, body in enumerate(bodies)
        )
        seen = observe(Solids(SegmentedMesh(parts)), camera, settings.noise_std, settings.sensor, rng)
        if seen.object_points >= 4 * MIN_POINTS:
            return seen.image.to_points()


def _plate(size: float, rng: np.random.Generator) -> trimesh.Trimesh:
    """Flat box, turned by up to ``STEEPEST_RAD`` from the line of sight."""
    plate = trimesh.creation.box([*(rng.uniform(0.5, 1.0, size=2) * size), 0.01 * size])
    roll = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi))
    tilt = Rotation.from_euler("zx", [rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, STEEPEST_RAD)])
    return _placed(plate, tilt * roll, np.zeros(3))


def _heap(size: float, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Boxes, balls and cylinders of a tenth to a half of ``size``, anywhere within it, any way up."""
    makers: tuple[Callable[[Float[np.ndarray, "3"]], trimesh.Trimesh], ...] = (
        lambda sides: trimesh.creation.box(sides),
        lambda sides: trimesh.creation.icosphere(subdivisions=2, radius=sides[0] / 2),
        lambda sides: trimesh.creation.cylinder(radius=sides[0] / 3, height=1.5 * sides[1], sections=24),
    )
    bodies = []
    for _ in range(int(rng.integers(FEWEST, MOST + 1))):
        body = makers[int(rng.integers(len(makers)))](rng.uniform(0.1, 0.5, size=3) * size)
        turned = Rotation.from_quat(rng.normal(size=4))
        bodies.append(_placed(body, turned, rng.uniform(-0.35, 0.35, size=3) * size))
    return bodies


def _placed(body: trimesh.Trimesh, turned: Rotation, place: Float[np.ndarray, "3"]) -> trimesh.Trimesh:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned.as_matrix(), place
    body.apply_transform(T)
    return body
