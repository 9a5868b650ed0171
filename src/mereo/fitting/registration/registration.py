"""The model registered to a frame: where each point of the object is, and where each of the frame was at rest."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, SupportsIndex

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from mereo.deformation.maps import newton
from mereo.deformation.moving_least_squares import Anchors
from mereo.fitting.config import FitConfig
from mereo.fitting.draws.playback import Drawn
from mereo.fitting.uncertainty import AT_ONCE, Explanation, Optimum, Uncertainty
from mereo.geometry.brief import counted
from mereo.geometry.conventions import LARGEST, check_real
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids, owned_centroids, signed_distance_and_direction
from mereo.geometry.transforms import Labels, Points, Transform, Values, checked_pose, fit_rigid, transform_points
from mereo.io.bounds import check_value
from mereo.scenes.statistical_model import StatisticalModel, following

Method = Literal["rest", "modes", "draws"]
"""Description of the state that was found: the rest model, unbent; coefficients of the modes; the scene's own draws."""

Place = Literal["camera", "rest"]
"""Frame of a point: the camera's, in the input's unit, or the rest model's, in scene units."""

BELIEVED = FitConfig.accepted
"""Share of a clean frame's points that a fit must explain to be believed."""


RIGHT = 0.75
"""Intersection over union with the truth from which on an answer is right; what is expected to have less is doubted."""


@dataclass(frozen=True, eq=False)
class Located:
    """Answer of a registration about points of the frame.

    Attributes:
        label: 0 for empty space, i + 1 for segment i.
        distance: to the nearest segment surface, negative inside; input unit.
        direction: unit vector to that surface.
        rest: where the point was at rest, scene units; outside, as if it moved along with the nearest segment.
    """

    label: Labels
    distance: Values
    direction: Points
    rest: Points

    def __repr__(self) -> str:
        return f"Located({counted(len(self.label), 'point')}, {int((self.label > 0).sum()):,} in a segment)"


@dataclass(frozen=True, eq=False)
class Registration:
    """A state of the object's statistical model, in the frame of an observed cloud.

    Attributes:
        material: positions of all material points in the camera frame, input unit.
        method: which description of the states it was found in.
        z: coefficients of the modes (at rest those nearest to it), or standard normal draws of the scene.
        scene_unit: length of a scene unit in the input's.
        unit_known: whether that was known beforehand; otherwise it was found together with the pose.
        explained: share of the observed points that lie on the model's facing surface, up to the tolerance.
        accepted: whether that is enough to believe it.
        seconds: of the fit alone.
        residual: root mean square distance of the observed points from the model's facing surface, input unit; None
            where the registration was read from a file.
        drawn: the scene's draws where ``method`` is "draws", with their seed: what plays the state again.
        ruled_out: share of the surface's vertices that the frame rules out, by more than a scene unit: they lie next to
            all that was seen of the object or in front of it; None where the registration was read from a file.
        needed: least ``explained`` of a frame of this noise to be believed.
        optimum: where the fit ended, from which uncertainty and explanations are made on first use; None
            where the registration was read from a file.
        radius_scale: factor of the radii by the weights' calibration of such fits to such frames; None without one.
        alike: number of different states that a search found to explain the frame alike, this one included.
    """

    model: StatisticalModel
    material: Float[np.ndarray, "m 3"]
    method: Method
    z: Float[np.ndarray, " k"]
    scene_unit: float
    unit_known: bool
    explained: float
    accepted: bool
    seconds: float
    drawn: Drawn | None = None
    residual: float | None = None
    ruled_out: float | None = None
    needed: float = BELIEVED
    optimum: Optimum | None = None
    radius_scale: float | None = None
    alike: int = 1

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        raise TypeError(
            "a registration cannot be pickled or copied, as it holds search structures of compiled libraries: store "
            "it with mereo.results.state.save_state, or keep its material and mesh"
        )

    def __repr__(self) -> str:
        trust = "" if self.accepted else "not believed, "
        unit = f"a scene unit is {self.scene_unit:.4g}"
        return f"Registration({self.description}, {trust}{unit}; {self.seconds:.1f} s)"

    @property
    def description(self) -> str:
        """Phrase on how well the frame is explained."""
        others = f"; {counted(self.alike - 1, 'other state')} would do so too" if self.alike > 1 else ""
        return f"registered model ({self.method}) explains {self.explained:.1%} of the observed points{others}"

    @property
    def doubt(self) -> str | None:
        """Sentence about a surface that the frame leaves open, with what to do; None where it does not."""
        if self.expected_iou is None or self.expected_iou >= RIGHT:
            return None
        return (
            "the frame leaves open where its surface is: its IoU with the true one is expected to be "
            f"{self.expected_iou:.2f} ({self.description}): take a frame from nearer, from another side, or of more of "
            "the object"
        )

    @property
    def expected_iou(self) -> float | None:
        """``Uncertainty.expected_iou``; None where the registration was read from a file."""
        return None if self.uncertainty is None else self.uncertainty.expected_iou

    @cached_property
    def modes_z(self) -> Float[np.ndarray, " k"]:
        """Coefficients of the modes nearest to the state, whatever describes it."""
        return self.z if self.method != "draws" else self.model.project(self.material / self.scene_unit)[1]

    @property
    def beyond_states(self) -> float:
        """How far the state lies outside all that the model has seen (``StatisticalModel.beyond``), scene units."""
        return self.model.beyond(self.modes_z)

    @property
    def model_scale(self) -> float:
        """Length of a unit of the object's own files, or of its scene where these are not known, in the input's."""
        source = self.model.source_frame
        return self.scene_unit * (1.0 if source is None else source.scale)

    def pose(self, rows: Bool[np.ndarray, " m"] | slice = slice(None)) -> Transform:
        """Best rigid motion of some material points, of the object's own files in the input's unit, to the frame."""
        return fit_rigid(self.model.source_points(self.scene_unit)[rows], self.material[rows])

    def segment_pose(self, label: int) -> Transform:
        """``pose`` of the segment of a label."""
        return self.pose(self.model.labels == label)

    @cached_property
    def mesh(self) -> SegmentedMesh:
        """The segments, with the rest mesh's own faces, in the camera frame and input unit."""
        return self.model.mesh(self.material)

    @cached_property
    def solids(self) -> Solids:
        """Segments in the camera frame, for queries of labels and distances."""
        return Solids(self.mesh)

    @cached_property
    def rest_solids(self) -> Solids:
        """Segments at rest, for the same queries."""
        return Solids(self.model.rest)

    def to_camera(self, points: ArrayLike, labels: Labels | None = None) -> Points:
        """Map points of the rest model to the camera frame.

        Args:
            points: n x 3, or x, y, z of one, rest pose, scene units.
            labels: of the segments that they move along with, 1 or more; by default those that hold them or come
                nearest.
        """
        points = rows_of_three(points)
        labels = nearest_labels(self.rest_solids, points) if labels is None else labels
        result = np.empty_like(points)
        for first in range(0, len(points), AT_ONCE):  # the weights of a large mesh would take gigabytes
            rows = slice(first, first + AT_ONCE)
            result[rows] = self.model.weights(points[rows], labels[rows])(self.material)
        return result

    def to_rest(self, points: ArrayLike, labels: Labels | None = None) -> Points:
        """Inverse of ``to_camera``: where n x 3 points of the camera frame are in the rest model, scene units."""
        points = rows_of_three(points)
        labels = nearest_labels(self.solids, points) if labels is None else labels
        guess = following(self._moved_anchors, points, labels)(self.model.rest_points)
        result = guess.copy()
        for label in np.unique(labels):
            rows = np.flatnonzero(labels == label)
            anchors = self.model.rest_anchors[label - 1]
            inverted, converged = newton(lambda at: anchors.weights(at)(self.material), points[rows], guess[rows])  # noqa: B023 (called at once)
            result[rows[converged]] = inverted[converged]
        return result

    def query(self, points: ArrayLike) -> Located:
        """Segment, signed distance, direction and rest position of n x 3 points of the camera frame."""
        points = rows_of_three(points)
        labels = self.solids.label(points)
        distance, direction = signed_distance_and_direction(self.solids, points, labels)
        nearest = np.where(labels > 0, labels, nearest_labels(self.solids, points)).astype(np.uint8)
        return Located(labels, distance, direction, self.to_rest(points, nearest))

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        """How far the true positions may be from the registered ones; None where it was read from a file."""
        if self.optimum is None:
            return None
        return Uncertainty(self.optimum, self.model, self.radius_scale)

    def radius95(self, points: ArrayLike, labels: Labels | None = None, *, at: Place) -> Values | None:
        """Radius around each point that holds its true position with probability 0.95, in the input's unit.

        The point is one of the object: that which the registration has at the given position of the camera frame, or
        that which was at the given position of the rest model. ``uncertainty`` has the radii of all vertices, and says
        whether they are calibrated. None where the registration was read from a file.

        Args:
            points: n x 3.
            labels: of the segments that they move along with, 1 or more; by default those that hold them or come
                nearest.
            at: "camera" for points of the camera frame in the input's unit, "rest" for scene units of the rest model.
        """
        check_value("at", at, Place, "camera")
        if self.uncertainty is None:
            return None
        return self.uncertainty.of_rest(*self._at_rest(rows_of_three(points), labels, at))

    def _at_rest(self, points: Points, labels: Labels | None, at: Place) -> tuple[Points, Labels]:
        """Rest positions of points, with the segments that they move along with."""
        if labels is None:
            labels = nearest_labels(self.solids if at == "camera" else self.rest_solids, points)
        return self.to_rest(points, labels) if at == "camera" else points, labels

    def explain(self, what: ArrayLike | str, *, at: Place = "camera") -> Explanation | None:
        """What decides where a point of the object is: observed points, the network, or what was known of its states.

        Args:
            what: x, y, z of a point; or the name of a segment, for its centroid.
            at: "camera" for a point of the camera frame in the input's unit, "rest" for scene units of the rest model.

        Returns None where the registration was read from a file. Raises ``ValueError`` for a name of no segment and
        for other than three coordinates.
        """
        check_value("at", at, Place, "camera")
        if self.uncertainty is None:
            return None
        if isinstance(what, str):
            names = self.model.rest.names
            if what not in names:
                raise ValueError(f"there is no segment {what!r}; the segments are {', '.join(names)}: name one of them")
            place = owned_centroids(self.mesh)[names.index(what)]
            motion = self.uncertainty.centroid_motion(names.index(what))
        else:
            rest, label = self._at_rest(rows_of_three(np.asarray(what)[None]), None, at)
            place = self.to_camera(rest, label)[0]
            motion = self.uncertainty.point_motion(rest, label)
        optimum = self.uncertainty.optimum  # in the camera frame of the fit, which need not be that of the registration
        T_registration_fit = fit_rigid(optimum.unit * optimum.posterior.material, self.material)
        return self.uncertainty.explain(place, motion, T_registration_fit)

    def moved(self, T_new_camera: Transform) -> "Registration":
        """Registration in another frame; raises ``ValueError`` for a transform that is not rigid."""
        return replace(self, material=transform_points(checked_pose(T_new_camera), self.material))

    @cached_property
    def _moved_anchors(self) -> tuple[Anchors, ...]:
        return tuple(Anchors(index, self.material[index]) for index in self.model.anchors)


def rows_of_three(points: ArrayLike) -> Points:
    """Points as an array of a row each, also where there is only x, y, z; raises ``ValueError`` for anything else."""
    given = np.asarray(points)
    check_real(given, "the array of points")
    array = np.atleast_2d(given.astype(np.float64))
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(
            f"the points have the shape {array.shape}; they must be rows of x, y, z: reshape them to (n, 3)"
        )
    bad = int((~(np.abs(array) <= LARGEST)).any(axis=1).sum())
    if bad:
        raise ValueError(
            f"{bad} of {counted(len(array), 'point')} are NaN, infinite or beyond {LARGEST:g}; all must be positions: "
            "leave them out"
        )
    return array


def nearest_labels(solids: Solids, points: Points) -> Labels:
    """The segment that holds each point, or else the nearest."""
    labels = solids.label(points)
    outside = np.flatnonzero(labels == 0)
    if len(outside):
        labels[outside] = solids.nearest(points[outside]).owner + 1
    return labels
