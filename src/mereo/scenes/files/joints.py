"""Joints that an assembly seems to have, for a new scene file: hinges on round contacts, slides on flat ones.

A joint moves all that hangs on its smaller side: what is still connected to it once the contacts are taken away that
the motion leaves closed. Its range is as far as nothing collides, up to a limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.deformation.maps import Rigid
from mereo.geometry.contacts import CLEARANCE, Contact, contacts, distance
from mereo.geometry.mesh import SegmentedMesh, surface_points
from mereo.geometry.overlap import overlaps

ANGLES_DEG = (30.0, 20.0, 10.0, 5.0)
"""Ranges of a hinge that are tried, to either side."""

SLIDES = (0.5, 0.25, 0.1)
"""Ranges of a slide that are tried, in lengths of the contact."""

COLLIDES = 0.01
"""Share of a segment that another may overlap within a joint's range."""

PARALLEL = float(np.cos(np.deg2rad(3.0)))

ROUND_TEST_RAD = 0.7
"""A part that such a turn brings onto itself does not show that it turns."""

TURNS_ON, SLIDES_ALONG = "#  - type: joint  # turns on", "#  - type: joint  # slides along"
"""Beginnings of the joints that a scene file proposes in comments."""


@dataclass(frozen=True, eq=False)
class Joint:
    """Proposed joint.

    Attributes:
        contact: what it was found from.
        hinge: whether it turns about ``axis``, else it slides along it.
        moved: indices of the segments that it moves.
        axis: unit vector.
        most: least and most angle in degrees, or way in the mesh's unit.
    """

    contact: Contact
    hinge: bool
    moved: tuple[int, ...]
    axis: Float[np.ndarray, "3"]
    most: tuple[float, float]


def proposed_joints(mesh: SegmentedMesh) -> tuple[Joint, ...]:
    """Joints of an assembly at rest, those that move least first, as a chain wants it."""
    found = contacts(mesh)
    reach = CLEARANCE * float((mesh.bounds[1] - mesh.bounds[0]).max())
    joints: list[Joint] = []
    for contact in sorted(found, key=lambda each: each.kind):  # cylinders before planes
        if contact.kind == "other" or _held(contact, joints):
            continue
        joint = _joint(mesh, found, contact, reach)
        if joint is not None and not any(_same(joint, other) for other in joints):
            joints.append(joint)
    return tuple(sorted(joints, key=lambda joint: len(joint.moved)))


def _held(contact: Contact, joints: Sequence[Joint]) -> bool:
    """Whether a flat contact lies across a hinge that turns its two parts on each other: it is part of that."""
    return contact.kind == "plane" and any(
        joint.hinge
        and abs(joint.axis @ contact.axis) > PARALLEL
        and len({contact.first, contact.second} & set(joint.moved)) == 1
        for joint in joints
    )


def _same(first: Joint, second: Joint) -> bool:
    return first.moved == second.moved and first.hinge == second.hinge and abs(first.axis @ second.axis) > PARALLEL


def _joint(mesh: SegmentedMesh, found: Sequence[Contact], contact: Contact, reach: float) -> Joint | None:
    """The joint of a contact; None where its sides hang together elsewhere, look alike in it, or collide at once."""
    hinge = contact.kind == "cylinder"
    axis = contact.axis if hinge else contact.along
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    side = _sides(len(mesh.segments), [each for each in found if not _allows(each, contact, hinge, axis, reach)])
    if side[contact.first] == side[contact.second]:
        return None
    groups = [tuple(np.flatnonzero(side == side[index]).tolist()) for index in (contact.first, contact.second)]
    for moved in sorted(groups, key=lambda group: sum(abs(mesh.segments[index].volume) for index in group)):
        if hinge and all(_is_round(mesh, index, contact.point, axis, reach) for index in moved):
            continue
        steps = ANGLES_DEG if hinge else tuple(contact.extent * share for share in SLIDES)
        least, most = (
            _free(mesh, moved, contact.point, axis, hinge, [sign * step for step in steps]) for sign in (-1, 1)
        )
        if most > least:
            return Joint(contact, hinge, moved, axis, (least, most))
    return None


def _sides(count: int, held: Sequence[Contact]) -> np.ndarray:
    """For each segment the number of the group that contacts hold together."""
    rows = np.array([(each.first, each.second) for each in held], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows)), rows.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _allows(contact: Contact, joint: Contact, hinge: bool, axis: Float[np.ndarray, "3"], reach: float) -> bool:
    """Whether a contact stays closed in a turn about, or a slide along, the axis of a joint."""
    aligned = abs(contact.axis @ axis)
    if contact.kind == "other":
        return False
    if contact.kind == "plane":
        return bool(aligned > PARALLEL if hinge else aligned < np.sqrt(1 - PARALLEL**2))
    away = contact.point - joint.point
    coaxial = np.linalg.norm(away - (away @ axis) * axis) < reach
    return bool(aligned > PARALLEL and (coaxial or not hinge))


def _is_round(
    mesh: SegmentedMesh, index: int, point: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], reach: float
) -> bool:
    """Whether a turn about the axis brings a segment onto itself."""
    segment = mesh.segments[index]
    points = surface_points(segment.vertices, segment.faces, 200)[0]
    turned = Rigid(ROUND_TEST_RAD * axis, np.zeros(3), point)(points)
    return bool(distance(turned, segment)[0].max() < reach)


def _free(
    mesh: SegmentedMesh,
    moved: tuple[int, ...],
    point: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    hinge: bool,
    steps: Sequence[float],
) -> float:
    """First of the steps, from the farthest to the nearest, over which nothing collides; 0 where there is none."""
    for step in steps:
        ways = [step * share for share in (0.5, 1.0)]
        if not any(_collides(mesh, moved, _motion(point, axis, hinge, way)) for way in ways):
            return step
    return 0.0


def _motion(point: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], hinge: bool, way: float) -> Rigid:
    turn, shift = (np.deg2rad(way) * axis, np.zeros(3)) if hinge else (np.zeros(3), way * axis)
    return Rigid(turn, shift, point)


def _collides(mesh: SegmentedMesh, moved: tuple[int, ...], motion: Rigid) -> bool:
    """Whether moved segments overlap others by more than they do at rest."""
    places = [motion(s.vertices) if index in moved else s.vertices for index, s in enumerate(mesh.segments)]
    inside = {mesh.names[index] for index in moved}
    found = overlaps(mesh.with_vertices(places), COLLIDES)
    return any(len({each.small, each.large} & inside) == 1 for each in found)
