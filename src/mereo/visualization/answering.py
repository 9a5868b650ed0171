"""From whatever a caller has of a frame to its result: what `mereo reconstruct` does with a file.

SensorFrame, points or a depth image -answer-> Result
"""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

import numpy as np
from jaxtyping import Float

from mereo.evaluation.sample_views import load_frame
from mereo.fitting.config import FitChoice
from mereo.fitting.registration import answer as fitting
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.io.sensor_frame import SensorFrame
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, SizeWarning, find_object, size_warning
from mereo.reconstruction.pipeline import EncodedFrame
from mereo.scenes.scene import Scene
from mereo.visualization.result import Result

ARRAY = Path("cloud")
"""Name of a frame that is no file's."""


def answer(
    frame: SensorFrame | Observation | PointCloud | DepthImage | Float[np.ndarray, "n 3"] | str | Path,
    model: Model | str | Path,
    fit: FitChoice | Registrar | None = "auto",
    resolution: int = 128,
    *,
    axes: CloudAxes | None = None,
    unit_m: float | None = None,
    isolation: IsolationConfig | None = None,
    scene: Scene | str | None = None,
    scene_unit: float | None = None,
    label_points: bool = False,
    encoded: EncodedFrame | None = None,
) -> Result:
    """Answer to one frame: the registered model itself where it explains the frame, else the network's surfaces.

    Args:
        frame: from ``load_frame``, or a file or shipped name for it; or points on the object or a depth image, any unit
            and density.
        model: the weights, or their shipped name or file.
        fit: "auto" takes the registered model where it explains the frame; "modes" and "full" in any case, full by
            fitting the draws of the scene as well; "off" leaves the network's answer. Or a registrar of the same
            object, set up once for many frames.
        resolution: cells along the longest side of the object's box.
        axes: of points: "camera" (default) is x right, y down, z forward; "scanner" is y up, z toward the scanner.
        unit_m: metres per unit of points or of a depth image; believed where the network's own estimate of the size
            agrees, and found together with the pose without it.
        isolation: what of the frame is left out; lengths in metres.
        scene: whose draws are fitted, where it is not the built-in one of the weights.
        scene_unit: length of a scene unit in the frame's unit, where it is known for certain.
        label_points: also say on which segment each point of the object lies.
        encoded: the likelier reading of the object's cloud as the model has understood it, where that is known already.

    Warns with ``SizeWarning`` where what is seen cannot be the object. Raises ``ValueError`` for unusable clouds, where
    nothing is found, for axes or a unit of a frame that states its own, and for other fits than "auto" where the model
    cannot be registered.
    """
    network = model if isinstance(model, Model) else load_model(model)
    given = load_frame(frame) if isinstance(frame, str | Path) else frame
    seen, stated = _observed(given, axes, unit_m, isolation)
    if isinstance(fit, Registrar):
        if scene is not None:
            raise ValueError("both a registrar and a scene are given; a registrar has its own: drop the scene")
        registrar: Registrar | None = fit
    else:
        registrar = registrar_for(network, _choice(fit), scene)
    found = fitting.answer(
        seen.cloud,
        network,
        registrar,
        resolution,
        seen.frame.axes,
        label_points,
        scene_unit,
        None if registrar is None or not stated else registrar.stated_unit(seen.frame.unit_m),
        keep_all=isolation is not None and isolation.keep_all,
        unit_assumed=not seen.frame.unit_stated,
        encoded=encoded,
    )
    result = Result.of(found, seen, network, registrar, resolution, stated)
    warning = size_warning(result.seen, network.provenance) if stated else None
    if warning is not None:
        warnings.warn(warning, SizeWarning, stacklevel=2)
    if not stated and result.unit.metres is not None:
        named = replace(result.seen.frame, unit_m=result.unit.metres)
        result = replace(result, seen=replace(result.seen, frame=named))
    return result


def _choice(fit: str | None) -> FitChoice:
    if fit is not None and fit not in get_args(FitChoice):
        raise ValueError(f"fit is {fit!r}; it must be one of {', '.join(get_args(FitChoice))}: correct the spelling")
    return cast(FitChoice, fit or "off")


def _observed(
    frame: SensorFrame | Observation | PointCloud | DepthImage | Float[np.ndarray, "n 3"],
    axes: CloudAxes | None,
    unit_m: float | None,
    isolation: IsolationConfig | None,
) -> tuple[Observation, bool]:
    """The object in whatever a caller has of a frame, and whether its unit was stated."""
    if isinstance(frame, SensorFrame | Observation):
        if axes is not None or unit_m is not None:
            raise ValueError(
                "axes or a unit are given for a frame that states its own; give them where it is read: "
                "mereo.load_frame(..., frame='scanner', unit_m=0.001)"
            )
        if isinstance(frame, Observation):
            return frame, True
        return find_object(frame, isolation or IsolationConfig()), True
    if unit_m is not None and not 0 < unit_m < np.inf:
        raise ValueError(f"the unit is {unit_m} m; it must be positive: give 0.001 for millimetres")
    if isolation is not None and unit_m is None and isolation != IsolationConfig(keep_all=isolation.keep_all):
        raise ValueError("isolation is in metres, and the unit of the points is not known: give unit_m")
    depth = frame if isinstance(frame, DepthImage) else None
    cloud = frame if isinstance(frame, PointCloud) else None
    if cloud is None:
        cloud = depth.to_points() if depth is not None else PointCloud(np.asarray(frame, dtype=np.float64))
    read = SensorFrame(ARRAY, cloud, 1.0 if unit_m is None else unit_m, axes or "camera", depth)
    return find_object(read, isolation or IsolationConfig()), unit_m is not None
