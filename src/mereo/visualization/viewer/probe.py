"""Probe of an answer or of surfaces, in the input's frame: what is known of a place, and which place a look meets."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import nearest_labels
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.solids import Solids, signed_distance_and_direction
from mereo.geometry.transforms import inverse_rigid, rigid, rotation_along, transform_points
from mereo.models.trained import Answer as NetworkAnswer

ON_SURFACE = 1e-6
"""Distance, as a share of a place's coordinates, that is none: a click meets the surface up to rounding."""


@dataclass(frozen=True, eq=False)
class Probed:
    """Facts about points of the input's frame, in its unit.

    Attributes:
        label: 0 for empty space, i + 1 for segment i.
        distance: to the nearest segment surface, negative inside; NaN where that is not known.
        direction: unit vector towards it; NaN where that is not known.
        probability: of empty space and each segment, by the network; None where there is none.
        rest: where the point was at rest, scene units; None where no model is registered.
        radius95: radius around the point that holds the true place of what is registered there with probability 0.95;
            None where that is not known.
    """

    label: UInt8[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    direction: Float[np.ndarray, "n 3"]
    probability: Float[np.ndarray, "n c"] | None = None
    rest: Float[np.ndarray, "n 3"] | None = None
    radius95: Float[np.ndarray, " n"] | None = None


def source_of(answer: Answer) -> str:
    """Where an answer comes from, and whether its frame shows the object, in a phrase for people."""
    if answer.registrar is None:
        return "network alone: the weights carry no statistical model"
    doubt = None if answer.registration is None else answer.recognition.told
    return answer.source if doubt is None else f"{answer.source}; {doubt}"


def ask_network(answer: Answer, points: Float[np.ndarray, "n 3"]) -> NetworkAnswer:
    """Answers of the network at points of the input's frame, in that frame; it must have been given the frame."""
    result = answer.reconstruction
    assert answer.model is not None and result.code is not None
    found = answer.model.query(result.code, transform_points(result.T_camera_input, points))
    direction = found.direction @ result.T_camera_input[:3, :3]
    return NetworkAnswer(found.label, found.probability, found.distance, direction)


def probe_answer(answer: Answer, points: Float[np.ndarray, "n 3"]) -> Probed:
    """Facts about points of the input's frame: those of the registered model where it is the answer."""
    network = None if answer.reconstruction.code is None else ask_network(answer, points)
    if answer.registered is None:
        assert network is not None
        return Probed(network.label, network.distance, network.direction, network.probability)
    found = answer.registered.query(points)
    return Probed(
        _with_surface(answer.registered.solids, found.label, found.distance, points),
        found.distance,
        found.direction,
        None if network is None else network.probability,
        found.rest,
        answer.registered.radius95(points, at="camera"),
    )


def probe_surfaces(solids: Solids, radii: Radii | None, points: Float[np.ndarray, "n 3"]) -> Probed:
    """Facts about points that closed surfaces alone say."""
    inside = solids.label(points)
    distance, direction = signed_distance_and_direction(solids, points, inside)
    label = _with_surface(solids, inside, distance, points)
    radius = None
    if radii is not None and label.all():
        radius = np.concatenate([radii.at(point[None], int(one)) for point, one in zip(points, label, strict=True)])
    return Probed(label, distance, direction, radius95=radius)


def _with_surface(
    solids: Solids, label: UInt8[np.ndarray, " n"], distance: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 3"]
) -> UInt8[np.ndarray, " n"]:
    """Labels, where a place on a surface is its segment's, whichever side rounding has put it on."""
    on_surface = (label == 0) & (np.abs(distance) <= ON_SURFACE * np.abs(points).max(axis=1))
    return np.where(on_surface, nearest_labels(solids, points), label).astype(np.uint8)


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
