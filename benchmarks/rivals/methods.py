"""The rivals: each maps a frame and its settings to where all material points of the object are."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float
from rivals.frames import Frame
from scipy.spatial.distance import cdist

from mereo.geometry.transforms import inverse_rigid, transform_points

Settings = dict[str, Any]

ICP_POINTS = 4000
"""Points of the model that the observed ones are brought onto; it is dense, so that planes can be estimated."""

INSTALL = {
    "small_gicp": "pip install small_gicp",
    "pycpd": "pip install pycpd",
    "rustcpd": "pip install rustcpd",
    "probreg": "pip install probreg (Python 3.9 to 3.11 and a C++ compiler)",
}


@dataclass(frozen=True, eq=False)
class Registered:
    """Answer of a rival: all material points in the camera frame, and whether it ended as it should."""

    material: Float[np.ndarray, "m 3"]
    finished: bool = True


Method = Callable[[Frame, Settings], Registered]


def library(name: str) -> ModuleType:
    """A rival's module; raises ``ImportError`` with a sentence that says what is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        cure = INSTALL[name.split(".")[0]]
        raise ImportError(f"{name}, a rival of this benchmark, cannot be imported ({error}): {cure}") from None


def stay(frame: Frame, settings: Settings) -> Registered:
    """The start pose itself."""
    return Registered(frame.posed)


def icp(frame: Frame, settings: Settings) -> Registered:
    """Rigid: the observed points are brought onto the model, every one of which has a counterpart there."""
    options = {key: value for key, value in settings.items() if key != "facing"}
    target = frame.posed[frame.source(ICP_POINTS, settings["facing"])]
    found = library("small_gicp").align(target, frame.cloud, **options)
    return Registered(transform_points(inverse_rigid(found.T_target_source), frame.posed))


# --- coherent point drift ---------------------------------------------------------------------------------------------


def clouds(frame: Frame, settings: Settings) -> tuple[np.ndarray, np.ndarray, Settings]:
    """Source and target in normalized coordinates, and the settings that are the algorithm's own."""
    chosen = frame.source(settings["count"], settings["facing"])
    own = {key: value for key, value in settings.items() if key not in ("count", "facing", "scale", "fast")}
    return frame.normalized(frame.posed[chosen]), frame.normalized(frame.cloud), own


def rust(settings: Settings) -> Settings:
    """Settings by the names that rustcpd gives them."""
    return {"outlier_weight" if key == "w" else key: value for key, value in settings.items()}


def rigid_cpd(frame: Frame, settings: Settings) -> Registered:
    """Rigid with a scale (pycpd knows no other), or, as ``scale`` is known here, without (rustcpd)."""
    source, target, own = clouds(frame, settings)
    points = frame.normalized(frame.posed)
    if settings["scale"]:
        found = library("pycpd").RigidRegistration(X=target, Y=source, **own)
        found.register()
        return Registered(frame.restored(found.transform_point_cloud(points)))
    result = library("rustcpd").register_rigid(target, source, scale=False, parallel=False, **rust(own))
    return Registered(frame.restored(points @ result.rotation + result.translation))


def affine_cpd(frame: Frame, settings: Settings) -> Registered:
    """Affine; with pycpd."""
    source, target, own = clouds(frame, settings)
    found = library("pycpd").AffineRegistration(X=target, Y=source, **own)
    found.register()
    return Registered(frame.restored(found.transform_point_cloud(frame.normalized(frame.posed))))


def deformable_cpd(frame: Frame, settings: Settings) -> Registered:
    """Deformable; with pycpd, or with rustcpd where it is to be ``fast``, to the same result.

    Other material points follow by the algorithm's own Gaussian kernel.
    """
    source, target, own = clouds(frame, settings)
    points = frame.normalized(frame.posed)
    if settings["fast"]:
        result = library("rustcpd").register_deformable(target, source, low_rank=None, parallel=False, **rust(own))
        return Registered(frame.restored(np.asarray(result.transform(points))))
    found = library("pycpd").DeformableRegistration(X=target, Y=source, **own)
    found.register()
    kernel = np.exp(-cdist(points, source, "sqeuclidean") / (2 * found.beta**2))
    return Registered(frame.restored(points + kernel @ found.W))


def atlas_cpd(frame: Frame, settings: Settings) -> Registered:
    """The statistical model's own mean and modes under the same mixture of Gaussians; with rustcpd."""
    source, target, own = clouds(frame, settings)
    chosen = frame.source(settings["count"], settings["facing"])
    turned = np.matmul(frame.rotation, frame.model.modes.astype(np.float64)) / frame.size
    std = np.sqrt((turned**2).sum(axis=(0, 1)))
    found = library("rustcpd").register_atlas(
        target,
        source,
        (turned[chosen] / std).reshape(3 * len(chosen), -1),
        (std**2).tolist(),
        with_scale=settings["scale"],
        parallel=False,
        **own,
    )
    shape = frame.normalized(frame.posed) + turned @ (found.coefficients / std)
    return Registered(frame.restored(found.scale * shape @ found.rotation + found.translation))


def bayesian_cpd(frame: Frame, settings: Settings) -> Registered:
    """Bayesian CPD of probreg, which divides by zero once a source point has no partner: then its last finite step."""
    source, target, own = clouds(frame, settings)
    bcpd = library("probreg.bcpd")
    steps: list[Any] = []
    finished = True
    try:
        with np.errstate(all="ignore"):
            bcpd.registration_bcpd(source, target, callbacks=[steps.append], **own)
    except (np.linalg.LinAlgError, ValueError):
        finished = False
    finite = [step for step in steps if np.isfinite(step.transform(source)).all()]
    if not finite:
        return Registered(frame.posed, False)
    points = frame.normalized(frame.posed)
    last = finite[-1]
    motion = np.linalg.solve(multiquadric(source, source), np.broadcast_to(last.v, source.shape))
    moved = last.rigid_trans.transform(points + multiquadric(points, source) @ motion)
    return Registered(frame.restored(moved), finished and len(finite) == len(steps))


def multiquadric(points: Float[np.ndarray, "n 3"], source: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "n s"]:
    """Inverse multiquadric kernel of width one, probreg's only one for Bayesian CPD."""
    return 1.0 / np.sqrt(cdist(points, source, "sqeuclidean") + 1.0)
