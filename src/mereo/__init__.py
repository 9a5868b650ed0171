"""Reconstruct deformable objects with all their segments, hidden side included, from one depth image or point cloud.

The public names below are loaded on first use (PEP 562), so that ``import mereo`` is instant and needs no torch.

Importing it sets ``OMP_WAIT_POLICY=passive`` for this process and those it starts, unless the variable is set already:
threads that wait for each other then sleep instead of spinning, which a busy machine needs. OpenMP reads the variable
once, when torch is loaded; a program that imports torch before mereo must set it itself.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mereo.camera import Camera as Camera
    from mereo.camera import DepthImage as DepthImage
    from mereo.camera import PointCloud as PointCloud
    from mereo.evaluation import evaluate as evaluate
    from mereo.files import read_camera as read_camera
    from mereo.files import read_depth_image as read_depth_image
    from mereo.files import read_point_cloud as read_point_cloud
    from mereo.mesh import Segment as Segment
    from mereo.mesh import SegmentedMesh as SegmentedMesh
    from mereo.model import Model as Model
    from mereo.reconstruction import reconstruct as reconstruct
    from mereo.reconstruction import write_reconstruction as write_reconstruction
    from mereo.scene import load_scene as load_scene
    from mereo.synthesis import synthesize as synthesize
    from mereo.weights import load_model as load_model

# Here and not where torch is used, because this runs before every import of torch that mereo makes. A thread that spins
# at a barrier holds the core that the thread it waits for needs: beside other work each barrier may cost a time slice.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_HOME = {
    "Camera": "camera",
    "DepthImage": "camera",
    "Model": "model",
    "PointCloud": "camera",
    "Segment": "mesh",
    "SegmentedMesh": "mesh",
    "evaluate": "evaluation",
    "load_model": "weights",
    "load_scene": "scene",
    "read_camera": "files",
    "read_depth_image": "files",
    "read_point_cloud": "files",
    "reconstruct": "reconstruction",
    "synthesize": "synthesis",
    "write_reconstruction": "reconstruction",
}
"""The module of each public name."""

__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("mereo")
        except PackageNotFoundError:
            return "0+unknown"
    if name not in _HOME:
        raise AttributeError(f"module 'mereo' has no attribute {name!r}")
    return getattr(import_module(f"mereo.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
