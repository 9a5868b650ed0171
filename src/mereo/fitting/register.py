"""From a network's reconstruction to the registered one: the model's own segments, where the frame shows them.

Reconstruction -fit-> Registration -segments, labels-> Reconstruction
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.config import FitChoice
from mereo.fitting.fit import fit
from mereo.fitting.playback import DrawnStates
from mereo.fitting.registration import Registration, nearest_labels
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.reconstruction.isosurfaces import Extraction
from mereo.reconstruction.pipeline import Reconstruction, turned_back
from mereo.reconstruction.segment_statistics import measure
from mereo.scenes.random_states import built_in_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES
from mereo.scenes.statistical_model import StatisticalModel


def register(
    result: Reconstruction, cloud: PointCloud | Float[np.ndarray, "n 3"], model: Model, choice: FitChoice = "auto"
) -> Registration:
    """Registration of the object's own deformation model to the cloud of a reconstruction.

    Args:
        result: of ``mereo.reconstruct``, whose encoded cloud is asked again.
        cloud: the same points, in the input's frame and unit.
        model: the weights.
        choice: "full" fits the draws of the weights' built-in scene as well; all others the modes alone.

    Returns the registration in the camera frame (``result.T_camera_input``), in the input's unit. Raises ``ValueError``
    where the weights carry no statistical model and know no built-in scene.
    """
    points = np.asarray(cloud.points if isinstance(cloud, PointCloud) else cloud, dtype=np.float64)
    seen = PointCloud(transform_points(result.T_camera_input, points))
    states = statistical_model_of(model)
    drawn = DrawnStates.of(load_scene(_scene_name(model)), states) if choice == "full" else None
    return fit(seen, model, states, states=drawn, code=result.code)


def statistical_model_of(model: Model) -> StatisticalModel:
    """Statistical model that the weights carry; older ones get that of their built-in scene, which takes seconds."""
    found = model.statistical_model or built_in_model(str(model.provenance.get("scene")), model.names)
    if found is None:
        raise ValueError(
            f"the weights of {', '.join(model.names)} carry no statistical model of their object's states; a "
            "registration needs one: finish the dataset with `mereo generate ... --resume` and train again, or leave "
            "out --fit"
        )
    return found


def _scene_name(model: Model) -> str:
    name = str(model.provenance.get("scene"))
    if name not in SCENES:
        raise ValueError(
            f"the weights were trained on {name!r}, which is no built-in scene; --fit full plays the draws of one: "
            "use --fit modes"
        )
    return name


def registered(
    result: Reconstruction, registration: Registration, model: Model, frame: CloudAxes = "camera"
) -> Reconstruction:
    """Reconstruction that is the registered model itself, with the resolution and in the frame of ``result``.

    Confidence stays the network's: its mean probability of a segment over the voxels that the registration gives it.
    """
    grid = _label_grid(registration.mesh, float(result.labels.spacing.max()))
    found = Extraction(registration.mesh, grid, 0)
    observed = result.observed
    if observed is not None:
        seen = transform_points(result.T_camera_input, observed.points)
        observed = replace(observed, labels=nearest_labels(registration.solids, seen))
    answer = replace(
        result,
        surfaces=registration.mesh,
        labels=grid,
        segments=measure(found, model, result.code),
        timings_s={**result.timings_s, "fit": registration.seconds},
        clipped=False,
        observed=observed,
    )
    return answer if frame == "camera" else turned_back(answer)


def _label_grid(mesh: SegmentedMesh, spacing: float) -> LabelGrid:
    """Labels of a mesh on a grid with one empty voxel around it."""
    low, high = mesh.bounds
    counts = np.ceil((high - low) / spacing).astype(int) + 3
    origin = (low + high - (counts - 1) * spacing) / 2
    x, y, z = (origin[axis] + np.arange(counts[axis]) * spacing for axis in range(3))
    labels: UInt8[np.ndarray, "x y z"] = label_grid(mesh, x, y, z)
    return LabelGrid(labels, origin, np.full(3, spacing), mesh.names)


def describe(registration: Registration) -> dict[str, object]:
    """Facts of a registration for a result's summary."""
    return {
        "method": registration.method,
        "explained": registration.explained,
        "accepted": registration.accepted,
        "scene_unit": registration.scene_unit,
        "coefficients": registration.z.tolist(),
        "seconds": registration.seconds,
    }
