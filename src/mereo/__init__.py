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
    from mereo.api.generate import generate as generate
    from mereo.api.objects import Object as Object
    from mereo.api.objects import load_object as load_object
    from mereo.api.reconstruct import Tracker as Tracker
    from mereo.api.reconstruct import load_frame as load_frame
    from mereo.api.reconstruct import reconstruct as reconstruct
    from mereo.api.result import Result as Result
    from mereo.api.result import load_result as load_result
    from mereo.api.steps import evaluate as evaluate
    from mereo.api.steps import export as export
    from mereo.api.steps import learn as learn
    from mereo.api.steps import train as train
    from mereo.api.view import view as view
    from mereo.geometry.camera import Camera as Camera
    from mereo.geometry.camera import DepthImage as DepthImage
    from mereo.geometry.camera import PointCloud as PointCloud
    from mereo.geometry.mesh import Segment as Segment
    from mereo.geometry.mesh import SegmentedMesh as SegmentedMesh
    from mereo.io.config import InputConfig as InputConfig
    from mereo.io.intrinsics import read_camera as read_camera
    from mereo.io.readers import read_depth_image as read_depth_image
    from mereo.io.readers import read_point_cloud as read_point_cloud
    from mereo.models.config import InferenceConfig as InferenceConfig
    from mereo.models.model import Model as Model
    from mereo.models.weights import load_model as load_model
    from mereo.reconstruction.config import IsolationConfig as IsolationConfig
    from mereo.scenes.registry import load_scene as load_scene
    from mereo.synthesis.config import GenerateConfig as GenerateConfig
    from mereo.synthesis.examples import synthesize as synthesize
    from mereo_learning.config import TrainConfig as TrainConfig

# Here and not where torch is used, because this runs before every import of torch that mereo makes. A thread that spins
# at a barrier holds the core that the thread it waits for needs: next to other work each barrier may cost a time slice.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_HOME = {
    "Camera": "mereo.geometry.camera",
    "DepthImage": "mereo.geometry.camera",
    "GenerateConfig": "mereo.synthesis.config",
    "InferenceConfig": "mereo.models.config",
    "InputConfig": "mereo.io.config",
    "IsolationConfig": "mereo.reconstruction.config",
    "Model": "mereo.models.model",
    "PointCloud": "mereo.geometry.camera",
    "Object": "mereo.api.objects",
    "Result": "mereo.api.result",
    "Segment": "mereo.geometry.mesh",
    "SegmentedMesh": "mereo.geometry.mesh",
    "Tracker": "mereo.api.reconstruct",
    "TrainConfig": "mereo_learning.config",
    "evaluate": "mereo.api.steps",
    "export": "mereo.api.steps",
    "generate": "mereo.api.generate",
    "learn": "mereo.api.steps",
    "load_frame": "mereo.api.reconstruct",
    "load_model": "mereo.models.weights",
    "load_object": "mereo.api.objects",
    "load_result": "mereo.api.result",
    "load_scene": "mereo.scenes.registry",
    "read_camera": "mereo.io.intrinsics",
    "read_depth_image": "mereo.io.readers",
    "read_point_cloud": "mereo.io.readers",
    "reconstruct": "mereo.api.reconstruct",
    "synthesize": "mereo.synthesis.examples",
    "train": "mereo.api.steps",
    "view": "mereo.api.view",
}
"""Module of each public name."""

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
    from mereo.io.extras import network_needed

    with network_needed():
        return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
