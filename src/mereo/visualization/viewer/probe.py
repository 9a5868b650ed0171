"""Probe of an answer, in the input's frame: what is known of a place, and which place a look meets."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.registration.answer import Answer as FrameAnswer
from mereo.fitting.registration.recognition import Recognition, recognize
from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, rigid, rotation_along, transform_points
from mereo.models.trained import Answer, EncodedCloud, Trained

ON_SURFACE = 1e-6
"""Distance, as a share of a place's coordinates, that is none: a click meets the surface up to rounding."""


@dataclass(frozen=True, eq=False)
class Probed:
    """Facts about points of the input's frame, in its unit.

    Attributes:
        label: 0 for empty space, i + 1 for segment i.
        distance: to the nearest segment surface, negative inside; NaN where that is not known.
        direction: unit vector towards it; NaN where that is not known.
        probability: of empty space and each segment, by the network; None where no frame was given to it.
        rest: where the point was at rest, scene units; None where no model is registered.
        radius95: radius around the point that holds the true place of what is registered there with probability 0.95;
            None where that is not known.
    """

    label: UInt8[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    direction: Float[np.ndarray, "n 3"]
    probability: Float[np.ndarray, "n c"] | None
    rest: Float[np.ndarray, "n 3"] | None
    radius95: Float[np.ndarray, " n"] | None = None


@dataclass(frozen=True, eq=False)
class Inspection:
    """Answer to a frame, and who is asked for more.

    Attributes:
        surfaces: all segments, in the input's frame.
        T_camera_input: from the input's frame to the camera frame.
        model: the weights; None of an object without.
        source: where the answer comes from, in a phrase.
        cloud: the object's points, in the input's frame; None for a state without its frame.
        code: what the weights made of the cloud, camera frame.
        registration: of the object's own model, camera frame, where the surfaces are that model.
        radii: how sure its vertices are, as files say it, in the input's frame; None where the registration knows it.
    """

    surfaces: SegmentedMesh
    T_camera_input: Float[np.ndarray, "4 4"]
    model: Trained | None
    source: str
    cloud: PointCloud | None = None
    code: EncodedCloud | None = None
    registration: Registration | None = None
    radii: Radii | None = None

    @classmethod
    def of_answer(cls, found: FrameAnswer) -> "Inspection":
        """Answer that is there already, with what it was asked from."""
        result = found.reconstruction
        return cls(
            surfaces=result.surfaces,
            T_camera_input=result.T_camera_input,
            model=found.model,
            source=source_of(found),
            cloud=result.reading.cloud,
            code=result.code,
            registration=found.registration if found.taken else None,
        )

    @classmethod
    def of_registration(
        cls,
        registration: Registration,
        model: Trained | None,
        T_camera_input: Float[np.ndarray, "4 4"],
        cloud: PointCloud | None = None,
    ) -> "Inspection":
        """Registration as a file has it, with the cloud that it belongs to, where that is at hand."""
        seen = None if cloud is None else PointCloud(transform_points(T_camera_input, cloud.points))
        return cls(
            surfaces=registration.mesh.transformed(inverse_rigid(T_camera_input)),
            T_camera_input=T_camera_input,
            model=model,
            source=explained(registration, recognize(registration, None if model is None else model.calibration)),
            cloud=cloud,
            code=None if seen is None or model is None else model.encode(seen),
            registration=registration,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of empty space and the segments, by label."""
        return ("empty space", *self.surfaces.names)

    @property
    def colors(self) -> tuple[Color, ...]:
        """Colours of the segments."""
        return self.surfaces.colors

    def network(self, points: Float[np.ndarray, "n 3"]) -> Answer:
        """Answers of the network at points of the input's frame, in that frame; ``ValueError`` without a frame."""
        if self.code is None or self.model is None:
            raise ValueError("there is no frame that the network has seen; name its depth image or point cloud")
        found = self.model.query(self.code, transform_points(self.T_camera_input, points))
        return Answer(found.label, found.probability, found.distance, self._turned(found.direction))

    def ask(self, points: Float[np.ndarray, "n 3"]) -> Probed:
        """Facts about points of the input's frame: those of the registered model where it is the answer."""
        told = None if self.code is None else self.network(points)
        if self.registration is not None:
            seen = transform_points(self.T_camera_input, points)
            found = self.registration.query(seen)
            # a click on a segment asks about it, whichever side rounding has put the place on
            on_it = (found.label == 0) & (np.abs(found.distance) <= ON_SURFACE * np.abs(points).max(axis=1))
            label = np.where(on_it, nearest_labels(self.registration.solids, seen), found.label).astype(np.uint8)
            chances = None if told is None else told.probability
            radius = self.registration.radius95(seen, at="camera")
            return Probed(label, found.distance, self._turned(found.direction), chances, found.rest, radius)
        told = self.network(points) if told is None else told
        return Probed(told.label, told.distance, told.direction, told.probability, None)

    @cached_property
    def here(self) -> Registration | None:
        """The registration in the input's frame, where it can say how sure it is."""
        if self.registration is None or self.registration.uncertainty is None:
            return None
        return self.registration.moved(inverse_rigid(self.T_camera_input))

    @property
    def sure(self) -> Radii | None:
        """Radii of 95 % of the surfaces' vertices, in the input's frame; None where they are not known."""
        here = self.here
        if here is None or here.uncertainty is None:
            return self.radii
        return here.uncertainty.radii(here.material)

    def _turned(self, direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Directions of the camera frame in the input's."""
        return direction @ self.T_camera_input[:3, :3]


def source_of(found: FrameAnswer) -> str:
    """Where an answer comes from, in a phrase for people."""
    if found.registrar is None:
        return "network alone: the weights carry no statistical model"
    if found.registration is not None and found.taken:
        return explained(found.registration, found.recognition)
    told = None if found.registration is None else found.recognition.told
    return found.source if told is None else f"{found.source}; {told}"


def explained(registration: Registration, recognition: Recognition) -> str:
    """How well a registration explains its frame, and whether that shows the object, in a phrase for people."""
    return registration.told if recognition.told is None else f"{registration.told}; {recognition.told}"


def first_hit(
    mesh: SegmentedMesh, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], shown: list[bool]
) -> Float[np.ndarray, "3"] | None:
    """Place where a ray first meets the surface of a segment that is shown; None where it meets none."""
    segments = tuple(s for s, visible in zip(mesh.segments, shown, strict=True) if visible and len(s.faces))
    if not segments:
        return None
    T_mesh_ray = rigid(rotation_along(direction), origin)  # the ray is the z axis
    seen = Solids(SegmentedMesh(segments).transformed(inverse_rigid(T_mesh_ray)))
    distance = seen.first_hit(np.array([[0.0, 0.0, 1.0]])).distance[0]
    return transform_points(T_mesh_ray, np.array([0.0, 0.0, distance])) if np.isfinite(distance) else None
