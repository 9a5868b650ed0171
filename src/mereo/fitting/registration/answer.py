"""Answer to one frame: the registered model itself where it explains the frame, else the network's surfaces.

cloud -fitted_frame-> FittedFrame -finish-> Registration -segments, labels-> Reconstruction
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.config import FitChoice
from mereo.fitting.registration.readings import FittedFrame, fitted_frame
from mereo.fitting.registration.recognition import NOT_ASKED, Recognition, recognized
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import inverse_rigid
from mereo.models.model import Model
from mereo.reconstruction.isosurfaces import Extraction
from mereo.reconstruction.pipeline import EncodedFrame, Reconstruction, extract, timed, turned_back
from mereo.reconstruction.segment_statistics import measure, segment_points


@dataclass(frozen=True, eq=False)
class Answer:
    """Answer to one frame, and where it comes from.

    Attributes:
        reconstruction: all segments, in the input's frame and unit.
        registration: of the object's deformation model, in the camera frame (``reconstruction.T_camera_input``) and the
            input's unit; None where none was asked for or none was found.
        taken: whether the reconstruction is the registered model; otherwise it is the network's.
        refusal: why no registration was found, where one was asked for.
        recognition: whether the frame shows the object, in a state that was learned; whoever answers.
    """

    reconstruction: Reconstruction
    registration: Registration | None = None
    taken: bool = False
    refusal: str | None = None
    recognition: Recognition = NOT_ASKED

    def __repr__(self) -> str:
        return f"Answer({self.source}; {self.reconstruction!r})"

    @cached_property
    def registered(self) -> Registration | None:
        """Registration in the input's frame, where the reconstruction is that model; else None."""
        if self.registration is None or not self.taken:
            return None
        return self.registration.moved(inverse_rigid(self.reconstruction.T_camera_input))

    @property
    def source(self) -> str:
        """Where the answer comes from, in a phrase."""
        if self.registration is None:
            return "network alone" if self.refusal is None else f"network alone: {self.refusal}"
        told = self.registration.told
        return told if self.taken else f"network alone: the {told}, too few"


def answer(
    cloud: PointCloud | Float[np.ndarray, "n 3"],
    model: Model,
    registrar: Registrar | FitChoice | None = "auto",
    resolution: int = 128,
    frame: CloudAxes = "camera",
    label_points: bool = False,
    scene_unit: float | None = None,
    stated_unit: float | None = None,
    keep_all: bool = False,
    unit_assumed: bool = False,
    encoded: EncodedFrame | None = None,
) -> Answer:
    """Answer to the frame that a cloud shows.

    Args:
        cloud: points on the object, any unit and density; strays among them are told by what a fit explains.
        model: the weights.
        registrar: of the same object, to be set up once for many frames, or the choice of one that is set up here; None
            asks the network alone. With "auto" a registration that does not explain the cloud leaves the answer to the
            network, with other choices it is taken all the same.
        resolution: cells along the longest side of the object's box.
        frame: the cloud's axes, as in ``mereo.reconstruct``.
        label_points: also say on which segment each point of the object lies.
        scene_unit: length of a scene unit in the cloud's unit, where it is known.
        stated_unit: the same as the input states it (``Registrar.stated_unit``), believed only where the network's own
            estimate agrees.
        keep_all: drop no strays.
        unit_assumed: ``stated_unit`` is only assumed: an object of another size is no sign of another object then.
        encoded: the likelier reading of the cloud as the model has understood it, where that is known already.

    Raises ``ValueError`` as ``mereo.reconstruct`` does, and for other choices than "auto" as ``fit_frame`` does.
    """
    if isinstance(registrar, str):
        registrar = registrar_for(model, registrar)
    found = fitted_frame(cloud, model, registrar, frame, scene_unit, stated_unit, keep_all, encoded)
    return answer_fitted(found, model, registrar, resolution, label_points, None if unit_assumed else stated_unit)


def answer_fitted(
    found: FittedFrame,
    model: Model,
    registrar: Registrar | None,
    resolution: int = 128,
    label_points: bool = False,
    stated_unit: float | None = None,
) -> Answer:
    """``answer`` to a frame that ``registrar`` has been fitted to already, with its arguments."""
    if registrar is not None and registrar.choice != "auto" and found.error is not None:
        raise found.error
    registration, refusal = None, None if found.error is None else str(found.error)
    if registrar is not None and found.modes is not None:
        registration = registrar.finish(found.modes)
    known = recognized(found, registration, model, stated_unit)
    if registrar is not None and registration is not None and registrar.takes(registration):
        result = registered(found.seen, registration, model, resolution, label_points)
        return Answer(result, registration, taken=True, recognition=known)
    result = extract(found.unaided, model, resolution, label_points)
    return Answer(result, registration, refusal=refusal, recognition=known)


def registered(
    seen: EncodedFrame, registration: Registration, model: Model, resolution: int = 128, label_points: bool = False
) -> Reconstruction:
    """Reconstruction that is the registered model itself, in the input's frame.

    Confidence stays the network's: its mean probability of a segment over the voxels that the registration gives it.
    """
    seconds = {**seen.timings_s, "fit": registration.seconds}
    mesh = registration.mesh
    with timed(seconds, "label"):
        low, high = mesh.bounds
        grid = padded_label_grid(mesh, float((high - low).max()) / resolution)
    with timed(seconds, "measure"):
        segments = measure(Extraction(mesh, grid, 0), model, seen.code)
    observed = None
    if label_points:
        with timed(seconds, "points"):
            observed = _observed(seen, registration, model)
    result = Reconstruction(
        surfaces=mesh,
        labels=grid,
        segments=segments,
        timings_s=seconds,
        evaluated=0,
        clipped=False,
        code=seen.code,
        T_camera_input=seen.T_camera_input,
        reading=seen.reading,
        observed=observed,
        calibrated=model.calibrates,
    )
    return result if seen.axes == "camera" else turned_back(result)


def _observed(seen: EncodedFrame, registration: Registration, model: Model) -> SegmentedCloud:
    """Segment of each observed point by the registration, with the network's probabilities of it."""
    points = seen.seen.points
    labels = nearest_labels(registration.solids, points)
    logits = model.logits(seen.code, points)
    return segment_points(logits, seen.points, model.names, model.colors, model.calibration, labels)


def padded_label_grid(mesh: SegmentedMesh, spacing: float) -> LabelGrid:
    """Labels of a mesh on a grid with one empty voxel around it."""
    low, high = mesh.bounds
    counts = np.ceil((high - low) / spacing).astype(int) + 3
    origin = (low + high - (counts - 1) * spacing) / 2
    x, y, z = (origin[axis] + np.arange(counts[axis]) * spacing for axis in range(3))
    labels: UInt8[np.ndarray, "x y z"] = label_grid(mesh, x, y, z)
    return LabelGrid(labels, origin, np.full(3, spacing), mesh.names)
