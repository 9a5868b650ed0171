"""Virtual depth camera: ray casting and Gaussian noise (paper, appendix B)."""

import numpy as np

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids


def render_depth(mesh: SegmentedMesh | Solids, camera: Camera) -> DepthImage:
    """Noise-free depth (z, not ray length) of a mesh given in the camera frame; 0 where no surface is hit.

    One ray goes through each pixel's centre. Depth is in the mesh's units, with the relative precision of single
    precision (about 1e-7). Both sides of a face are seen, so a camera inside a segment sees its inner wall. Pass the
    mesh's ``Solids`` where they are needed anyway: their search structures are used.
    """
    solids = mesh if isinstance(mesh, Solids) else Solids(mesh)
    depth = solids.first_hit(camera.directions().reshape(-1, 3)).distance
    return DepthImage(np.where(np.isfinite(depth), depth, 0.0).reshape(camera.height, camera.width), camera)


def add_depth_noise(image: DepthImage, std: float, rng: np.random.Generator) -> DepthImage:
    """Depth image with Gaussian noise of standard deviation ``std`` (the depth's unit) on every measured pixel.

    Misses stay misses.

    ``rng`` advances by one number per pixel, measured or not. Raises ``ValueError`` when ``std`` is not finite and at
    least 0.
    """
    if not 0 <= std < np.inf:
        raise ValueError(f"the depth noise is {std}; it is a standard deviation, finite and at least 0: correct it")
    noisy = image.depth + rng.normal(0.0, std, size=image.depth.shape)
    # noise cannot turn a hit into a miss, which is what a depth of 0 would mean
    return DepthImage(np.where(image.valid, np.maximum(noisy, np.finfo(np.float32).tiny), 0.0), image.camera)
