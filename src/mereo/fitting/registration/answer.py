"""The answer to a frame and the fits that led to it; its surfaces are made on first use."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import LocatedBy, Tracking
from mereo.fitting.registration.recognition import NOT_EVALUATED, Recognition
from mereo.fitting.registration.register import ModesFit, Registrar
from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.progress import stage
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.isosurfaces import Extraction, check_nodes
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import (
    EncodedFrame,
    Reconstruction,
    encode_frame,
    extract,
    measure,
    segment_points,
    timed,
    turned_back,
)

NO_OUTLINE = 0.9
"""``Evidence.hidden_edge`` from which on a frame shows no outline: planes have 1, views that are 75 % hidden .58."""

PATCH = 0.02
"""Share of the points by which a smooth patch may explain fewer than the object, and still explains as many."""


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """Modes fitted to the points that one hypothesis takes for the object's.

    Attributes:
        encoded: these points, in the camera frame.
        modes: the fit; None where none was wanted, or where something else is likelier.
    """

    encoded: EncodedFrame
    modes: ModesFit | None = None
    located_by: LocatedBy = "search"

    @property
    def hypothesis(self) -> Reading:
        """Which of the points are taken for the object's."""
        return self.encoded.reading

    @cached_property
    def is_accepted(self) -> bool:
        """Whether the fit explains the frame."""
        return self.modes is not None and self.modes.registration.accepted

    @cached_property
    def off_surface(self) -> Float[np.ndarray, " n"]:
        """Distance of each of all points from the facing surface, scene units."""
        assert self.modes is not None
        points = transform_points(self.encoded.T_camera_input, self.hypothesis.whole.points)
        return self.modes.surface.nearest(points / self.modes.unit)[0]

    @property
    def is_featureless(self) -> bool:
        """Whether the frame shows neither outline nor relief, so that any smooth surface explains it as well.

        Parts of planes show neither, and many objects with an unknown unit, or with a flat side, explain them. A given
        pose decides, as in ``unseen``.
        """
        if self.modes is None or self.located_by == "pose":
            return False
        evidence = self.modes.problem.evidence
        is_cut = evidence.hidden_edge > NO_OUTLINE
        return is_cut and evidence.patch_share(self.modes.tolerance) > self.modes.registration.explained - PATCH

    def explained(self, tolerance: float) -> float:
        """Share of all points, outliers included, that lie on the facing surface up to a tolerance in scene units."""
        return float((self.off_surface <= tolerance).mean())

    def unseen(self, registration: Registration) -> float | None:
        """Share of what the camera would see of a registration that it has not seen (``Evidence.unseen``).

        None where a pose is given: its giver knows the object.
        """
        if self.modes is None or self.located_by == "pose":
            return None
        return self.modes.problem.evidence.unseen((registration.material / self.modes.unit)[registration.model.faces])


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """Answer to one frame.

    Attributes:
        seen: the object in the frame: the points that the answer takes for its own, in the frame's axes and unit.
        model: the weights; None of an object without.
        registrar: of the object's deformation model; None where the network alone answers.
        hypothesis: all points that were given, and which of them ``seen`` has.
        T_camera_input: from the frame's axes to the camera frame.
        candidate: the fit to the frame by itself; None where the last frame's state led to the answer.
        registration: of the deformation model, in the camera frame and the frame's unit; None without one.
        recognition: whether the frame shows the object, in a state that was learned; whoever answers.
        resolution: cells along the longest side of the object's box in ``reconstruction``.
        label_points: whether ``reconstruction`` also labels the observed points by segment.
        seconds: that it took, without ``reconstruction``.
        located_by: who found the object; of a tracked answer, when it began to be followed.
        tracking: of a tracked object; a lost one has no pose, and ``recognition`` has the reason.
        further: answers to further instances of the object in the same frame, the most evident first.
    """

    seen: Observation
    model: Trained | None
    registrar: Registrar | None
    hypothesis: Reading
    T_camera_input: Float[np.ndarray, "4 4"]
    candidate: Candidate | None = None
    registration: Registration | None = None
    recognition: Recognition = NOT_EVALUATED
    resolution: int = 128
    label_points: bool = False
    seconds: float = 0.0
    located_by: LocatedBy = "network"
    tracking: Tracking = "found"
    further: "tuple[Answer, ...]" = ()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.seen.frame.source!r}: {self.source})"

    @property
    def tracked(self) -> bool:
        """Whether the last frame's state led to the answer, without the network."""
        return self.tracking == "followed"

    @property
    def is_missing(self) -> bool:
        """Whether there are no surfaces: the object is lost."""
        return self.tracking == "lost"

    @property
    def source(self) -> str:
        """Where the answer comes from, in a phrase."""
        if self.is_missing:
            return "lost"
        return "network alone" if self.registration is None else self.registration.description

    @cached_property
    def registered(self) -> Registration | None:
        """Registration in the frame's own axes; None where the network alone answers, and of a lost object."""
        registration = self.registration
        return None if registration is None else registration.moved(inverse_rigid(self.T_camera_input))

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Surfaces, label grid and figures of all segments, in the frame's axes and unit.

        Raises ``ValueError`` where the network alone answers and finds no segment, and of a lost object.
        """
        if self.is_missing:
            raise ValueError(self.recognition.reason)
        with stage("extract surfaces and labels"):
            if self.registration is not None:
                return self._registered_reconstruction(self.registration)
            assert self.model is not None
            return extract(self.encoded, self.model, self.resolution, self.label_points)

    def _registered_reconstruction(self, registration: Registration) -> Reconstruction:
        """Make the reconstruction that is the registered model itself.

        Confidence stays the network's: its mean probability of a segment over the voxels that the registration gives
        it; NaN without a network.
        """
        seen, model = self.encoded, self.model
        spent = sum(seen.timings_s.values())  # of ``seconds``, which is 0 of one of several instances
        seconds = {**seen.timings_s, "fit": max(self.seconds - spent, registration.seconds)}
        mesh = registration.mesh
        with timed(seconds, "label"):
            low, high = mesh.bounds
            spacing = float((high - low).max()) / self.resolution
            counts = np.ceil((high - low) / spacing).astype(int) + 3  # with one empty voxel around
            check_nodes(self.resolution, *counts.tolist())
            origin = (low + high - (counts - 1) * spacing) / 2
            labels = label_grid(mesh, *(origin[axis] + np.arange(counts[axis]) * spacing for axis in range(3)))
            grid = LabelGrid(labels, origin, np.full(3, spacing), mesh.names)
        with timed(seconds, "measure"):
            segments = measure(Extraction(mesh, grid, 0), model, seen.code)
        observed = None
        if self.label_points:
            with timed(seconds, "points"):
                points = seen.seen.points
                owner = nearest_labels(registration.solids, points)
                unknown = np.full(len(points), np.nan)
                observed = SegmentedCloud(seen.points, owner, unknown, unknown, mesh.names, mesh.colors)
                if model is not None and seen.code is not None:
                    logits = model.logits(seen.code, points)
                    observed = segment_points(logits, seen.points, model.names, model.colors, model.calibration, owner)
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
            calibrated=model is not None and model.calibrates,
        )
        return result if seen.axes == "camera" else turned_back(result)

    @cached_property
    def surfaces(self) -> SegmentedMesh:
        """Surfaces of all segments alone, in the frame's axes and unit; raises as ``reconstruction`` does."""
        return self.reconstruction.surfaces if self.registered is None else self.registered.mesh

    @cached_property
    def encoded(self) -> EncodedFrame:
        """Points that the answer takes for the object's, encoded by the network, if there is one."""
        if self.candidate is not None and self.candidate.encoded.code is not None:
            return self.candidate.encoded
        return encode_frame(self.hypothesis, self.model, self.seen.frame.axes)
