"""The virtual depth camera: ray casting and sensor noise (paper, appendix B)."""

import numpy as np

from mereo.camera import Camera, DepthImage
from mereo.mesh import SegmentedMesh
from mereo.solid import ray_scene


def render_depth(mesh: SegmentedMesh, camera: Camera) -> DepthImage:
    """Noise-free depth (z, not ray length) of a mesh given in the camera frame; 0 where no surface is hit."""
    vertices, faces, _ = mesh.merged()
    directions = camera.directions().reshape(-1, 3).astype(np.float32)
    hits = ray_scene(vertices, faces).run(np.zeros_like(directions), directions, output=True)
    # the directions have z = 1, so the ray parameter is the depth
    depth = np.where(hits["primID"] >= 0, hits["tfar"], 0.0)
    return DepthImage(depth.reshape(camera.height, camera.width).astype(np.float64), camera)


def add_depth_noise(image: DepthImage, std: float, rng: np.random.Generator) -> DepthImage:
    """Gaussian noise of standard deviation ``std`` (the depth's unit) on every measured pixel."""
    noise = rng.normal(0.0, std, size=image.depth.shape) if std > 0 else np.zeros_like(image.depth)
    noisy = np.where(image.valid, np.maximum(image.depth + noise, 1e-6), 0.0)
    return DepthImage(noisy, image.camera)
