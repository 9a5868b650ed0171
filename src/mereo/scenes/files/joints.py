"""Joints that an assembly seems to have, for a new scene file: hinges on round contacts, slides on flat ones.

A joint moves all that hangs on its smaller side: what is still connected to it once the contacts are taken away that
the motion leaves closed. Its range is as far as nothing collides, up to a limit: first by itself, then with the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from math import radians

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import eigh, lstsq, norm
from numpy.random import default_rng

from mereo.deformation.maps import Compose, Rigid
from mereo.geometry.conventions import Pair, Range, WholeNumbers
from mereo.geometry.mesh import Segment, SegmentedMesh, area_vectors, connected, surface_points
from mereo.geometry.mesh_check import overlaps
from mereo.geometry.solids import search_tree
from mereo.geometry.transforms import Flags, Indices, Points, Values, Vector, longest_side, unit_rows

# --- contacts ---------------------------------------------------------------------------------------------------------

# Points of one part's surface that are near the other, with normals against its normals, are the contact. Planes are
# taken out of it first, as clusters of one normal and offset. What is left is a cylinder where its normals are all
# across one axis, and then centre and radius are linear in points p and normals n: ``p - radius n = center``.

CLEARANCE = 0.005
AGAINST = -0.8
"""Largest gap that counts as contact, in longest sides of the object, for fits have some; largest cosine of normals."""

POINTS, LEAST_POINTS = 1500, 12
"""Places of a part's surface that are tried, and fewest that are a contact."""

PLANE_SHARE = 0.1
"""Share of a contact that has one normal before it counts as a plane; facets of a round face have less from 11 on."""

SAME_NORMAL = float(np.cos(radians(3.0)))

FLATTEST, LEAST_ARC, MISFIT = 0.02, 0.1, 0.05
"""Mean square cosine of a cylinder's normals with its axis at most, and of them across their main direction at least
(an arc of 80 degrees or so); root mean square distance of the points from the cylinder at most, in radii."""


@dataclass(frozen=True, eq=False)
class Contact:
    """Shape along which two segments touch.

    Attributes:
        first, second: indices of the segments, the one of the smaller surface first.
        kind: "cylinder", "plane", or "other", along which nothing is assumed to move.
        point: the middle of the contact, on a cylinder's axis.
        axis: unit vector along a cylinder, or a plane's normal; zero for others.
        along: the longest direction of the contact; for a cylinder its axis.
        radius: of a cylinder; 0 for others.
        extent: of the contact along ``along``.
    """

    first: int
    second: int
    kind: str
    point: Vector
    axis: Vector
    along: Vector
    radius: float
    extent: float


def contacts(mesh: SegmentedMesh) -> tuple[Contact, ...]:
    """All contacts between segments, which need not be solids. Lengths are in the mesh's unit."""
    reach = CLEARANCE * longest_side(mesh.bounds)
    vectors = [area_vectors(segment.vertices, segment.faces) for segment in mesh.segments]
    areas = [float(norm(each, axis=1).sum()) for each in vectors]
    touching = list[Contact]()
    for pair in combinations(range(len(mesh.segments)), 2):
        first, second = sorted(pair, key=lambda index: areas[index])
        points, normals = _touching(mesh.segments[first], mesh.segments[second], reach)
        if len(points) >= LEAST_POINTS:
            touching += _shapes(first, second, points, normals, reach)
    return tuple(touching)


def _normals(segment: Segment, face: Indices) -> Points:
    """Unit normals of faces."""
    return unit_rows(area_vectors(segment.vertices, segment.faces[face]))


def _distance(points: Points, segment: Segment) -> tuple[Values, Indices]:
    """Distance of points to a surface, and the nearest face."""
    vertices, faces = np.array(segment.vertices), np.array(segment.faces, np.int64)
    squared, face, _ = search_tree(vertices, faces).squared_distance(vertices, faces, np.ascontiguousarray(points))
    return np.sqrt(squared), face.astype(np.int64)


def _touching(first: Segment, second: Segment, reach: float) -> tuple[Points, Points]:
    """Points of the first surface that lie against the second one, and their normals."""
    low, high = second.bounds[0] - reach, second.bounds[1] + reach
    if (first.bounds[1] < low).any() or (first.bounds[0] > high).any():
        return np.empty((0, 3)), np.empty((0, 3))
    points, face = surface_points(first.vertices, first.faces, POINTS)
    near = ((points >= low) & (points <= high)).all(axis=1)
    points = points[near]
    normals = _normals(first, face[near])
    if len(points) == 0:
        return points, normals
    gap, opposite = _distance(points, second)
    against = (gap < reach) & (np.einsum("ni,ni->n", normals, _normals(second, opposite)) < AGAINST)
    return points[against], normals[against]


def _shapes(first: int, second: int, points: Points, normals: Points, reach: float) -> list[Contact]:
    """Planes of a contact, largest first, and what is left of it."""
    touching = []
    count = len(points)
    while len(points) >= LEAST_POINTS:
        flat = _largest_plane(points, normals, reach)
        if flat.sum() < max(PLANE_SHARE * count, LEAST_POINTS):
            break
        axis, along, extent = normals[flat].mean(axis=0), *_longest(points[flat])
        axis /= norm(axis)
        touching.append(Contact(first, second, "plane", points[flat].mean(axis=0), axis, along, 0.0, extent))
        points, normals = points[~flat], normals[~flat]
    if len(points) >= LEAST_POINTS:
        along, extent = _longest(points)
        other = Contact(first, second, "other", points.mean(axis=0), np.zeros(3), along, 0.0, extent)
        touching.append(_cylinder(first, second, points, normals) or other)
    return touching


def _largest_plane(points: Points, normals: Points, reach: float) -> Flags:
    """The largest set of points of one normal and offset."""
    offsets = normals @ points.T  # of all points along each one's normal
    alike = (normals @ normals.T > SAME_NORMAL) & (np.abs(offsets - np.diag(offsets)[:, None]) < reach)
    return alike[alike.sum(axis=1).argmax()]


def _longest(points: Points) -> tuple[Vector, float]:
    """Direction in which points spread most, and how far."""
    along = eigh(np.cov(points.T))[1][:, -1]
    return along, float(np.ptp(points @ along))


def _cylinder(first: int, second: int, points: Points, normals: Points) -> Contact | None:
    """Cylinder through points with its normals; None where they are of none."""
    values, vectors = eigh(normals.T @ normals / len(normals))
    if values[0] > FLATTEST or values[1] < LEAST_ARC:
        return None
    axis, across = vectors[:, 0], vectors[:, 1:]
    flat, outward = points @ across, normals @ across
    # two equations per point: flat - radius * outward = center
    system = np.zeros((2 * len(points), 3))
    system[0::2, 0] = system[1::2, 1] = 1.0
    system[:, 2] = outward.ravel()
    solution = lstsq(system, flat.ravel(), rcond=None)[0]
    center = solution[:2]
    radius = abs(float(solution[2]))
    misfit = norm(flat - center, axis=1) - radius
    if not np.sqrt(np.mean(misfit**2)) < MISFIT * radius:
        return None
    height = points @ axis
    middle = across @ center + axis * (height.min() + height.max()) / 2
    return Contact(first, second, "cylinder", middle, axis, axis, radius, float(np.ptp(height)))


# --- joints -----------------------------------------------------------------------------------------------------------

ANGLES_DEG = (30.0, 20.0, 10.0, 5.0)
"""Ranges of a hinge that are tried, to either side."""

SLIDES = (0.5, 0.25, 0.1)
"""Ranges of a slide that are tried, in lengths of the contact."""

COLLIDES = 0.01
"""Share of a segment that another may overlap: half of what a check allows, because states lie between those tried."""

STATES, MOST_MOVED = 128, 10_000_000
"""States in which all joints are tried: at most half of them corners of the box of ranges, then some with joints at
rest, then random ones; an eighth at least, where faces of all of them times joints are more than the second number."""

MOST_PASSES = 8
"""Passes over all states, in states; what still collides then is given up."""

NARROWER, NARROWEST = 0.8, 0.2
"""Factor of the ranges that take part in a collision, and share of a joint's range below which it is given up."""

PARALLEL = float(np.cos(radians(3.0)))

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
        most: least and most angle in degrees, or way in the mesh's unit, between which no joints collide together.
        alone: the same where all other joints rest.
    """

    contact: Contact
    hinge: bool
    moved: WholeNumbers
    axis: Vector
    most: Range
    alone: Range

    @property
    def narrowed(self) -> bool:
        """Whether it moves less far than it could by itself."""
        return self.most != self.alone


def proposed_joints(mesh: SegmentedMesh) -> tuple[Joint, ...]:
    """Joints of an assembly at rest, those that move least first, as a chain wants it."""
    touching = contacts(mesh)
    test = _CollisionTest(mesh)
    joints = list[Joint]()
    for contact in sorted(touching, key=lambda each: each.kind):  # cylinders before planes
        if contact.kind == "other" or _held(contact, joints):
            continue
        joint = _joint(test, touching, contact, joints)
        if joint is not None and not any(
            (joint.moved, joint.hinge) == (other.moved, other.hinge) and abs(joint.axis @ other.axis) > PARALLEL
            for other in joints
        ):
            joints.append(joint)
    return _narrowed(test, sorted(joints, key=lambda joint: len(joint.moved)))


def _held(contact: Contact, joints: Sequence[Joint]) -> bool:
    """Whether a flat contact lies across a hinge that turns its two parts on each other: it is part of that."""
    return contact.kind == "plane" and any(
        joint.hinge
        and abs(joint.axis @ contact.axis) > PARALLEL
        and len({contact.first, contact.second} & set(joint.moved)) == 1
        for joint in joints
    )


def _joint(
    test: "_CollisionTest", touching: Sequence[Contact], contact: Contact, joints: Sequence[Joint]
) -> Joint | None:
    """The joint of a contact; None where its sides are joined apart from it, look alike in it, or collide at once."""
    mesh, reach = test.mesh, test.reach
    hinge = contact.kind == "cylinder"
    axis = contact.axis if hinge else contact.along
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    closed = [(each.first, each.second) for each in touching if not _allows(each, contact, hinge, axis, reach)]
    side = connected(np.array(closed, np.int64).reshape(-1, 2), len(mesh.segments))
    if side[contact.first] == side[contact.second]:
        return None
    groups = [tuple(np.flatnonzero(side == side[index]).tolist()) for index in (contact.first, contact.second)]
    for moved in sorted(groups, key=lambda group: sum(abs(mesh.segments[index].volume) for index in group)):
        if hinge and all(_is_round(mesh.segments[index], contact.point, axis, reach) for index in moved):
            continue
        # of two that share segments one holds all of the other's, or it turns about a pivot that the other carries away
        if any(set(moved) & (rest := set(other.moved)) and set(moved) - rest and rest - set(moved) for other in joints):
            continue
        steps = ANGLES_DEG if hinge else tuple(contact.extent * share for share in SLIDES)
        joint = Joint(contact, hinge, moved, axis, (0.0, 0.0), (0.0, 0.0))
        least, most = (test.free(joint, [sign * step for step in steps]) for sign in (-1, 1))
        if most > least:
            return replace(joint, most=(least, most), alone=(least, most))
    return None


def _allows(contact: Contact, joint: Contact, hinge: bool, axis: Vector, reach: float) -> bool:
    """Whether a contact stays closed in a turn about, or a slide along, the axis of a joint."""
    aligned = abs(contact.axis @ axis)
    if contact.kind == "other":
        return False
    if contact.kind == "plane":
        return bool(aligned > PARALLEL if hinge else aligned < np.sqrt(1 - PARALLEL**2))
    away = contact.point - joint.point
    coaxial = norm(away - (away @ axis) * axis) < reach
    return bool(aligned > PARALLEL and (coaxial or not hinge))


def _is_round(segment: Segment, point: Vector, axis: Vector, reach: float) -> bool:
    """Whether a turn about the axis brings a segment onto itself."""
    points = surface_points(segment.vertices, segment.faces, 200)[0]
    turned = Rigid(ROUND_TEST_RAD * axis, np.zeros(3), point)(points)
    return bool(_distance(turned, segment)[0].max() < reach)


# --- joints together --------------------------------------------------------------------------------------------------


class _CollisionTest:
    """Test whether segments collide where joints have moved them; ``reach`` is the largest gap of a contact."""

    def __init__(self, mesh: SegmentedMesh) -> None:
        self.mesh = mesh
        self.reach = CLEARANCE * longest_side(mesh.bounds)
        self._known = dict[tuple[Pair, tuple[Chain, Chain]], bool]()

    def free(self, joint: Joint, steps: Sequence[float]) -> float:
        """First of the steps, from the farthest to the nearest, over which nothing collides; 0 where there is none."""
        free = (step for step in steps if not any(self.pairs([joint], [step * share]) for share in (0.5, 1.0)))
        return next(free, 0.0)

    def pairs(self, joints: Sequence[Joint], ways: Sequence[float]) -> list[Pair]:
        """Indices of the segments that collide where each joint has gone its way, in degrees or the mesh's unit."""
        motions = [(joint, way) for joint, way in zip(joints, ways, strict=True) if way]
        chains = [tuple(each for each in motions if index in each[0].moved) for index in range(len(self.mesh.segments))]
        places = [
            Compose(tuple(_motion(*each) for each in chain))(segment.vertices) if chain else segment.vertices
            for chain, segment in zip(chains, self.mesh.segments, strict=True)
        ]
        apart = {
            (min(index, other), max(index, other))
            for index, chain in enumerate(chains)
            for other in (range(len(chains)) if chain else ())
            if chains[other] != chain
        }
        keys = {(i, j): _relative(chains[i], chains[j]) for i, j in sorted(apart)}
        untested = {pair for pair, key in keys.items() if (pair, key) not in self._known}
        pairs = overlaps(self.mesh.with_vertices(places), COLLIDES, untested) if untested else ()
        index = {name: number for number, name in enumerate(self.mesh.names)}
        overlapping = {tuple(sorted((index[each.small], index[each.large]))) for each in pairs}
        self._known |= {(pair, keys[pair]): pair in overlapping for pair in untested}
        return [pair for pair, key in keys.items() if self._known[pair, key]]


Chain = tuple[tuple[Joint, float], ...]
"""Motions of joints by their ways, in the order in which they are applied."""


def _relative(first: Chain, second: Chain) -> tuple[Chain, Chain]:
    """Chains without the motions at their ends that both share: these move two segments as a whole."""
    while first and second and first[-1] == second[-1]:
        first, second = first[:-1], second[:-1]
    return first, second


def _motion(joint: Joint, way: float) -> Rigid:
    """Rigid motion of a joint by an angle in degrees, or a way in the mesh's unit."""
    turn, shift = (np.deg2rad(way) * joint.axis, np.zeros(3)) if joint.hinge else (np.zeros(3), way * joint.axis)
    return Rigid(turn, shift, joint.contact.point)


def _narrowed(test: _CollisionTest, joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """Joints in ranges within which no combination that is tried collides; without those of which nothing is left.

    Each collision narrows the ranges, on the side in use, of all joints that move one of the two segments alone. This
    ends where a whole pass over all combinations finds no collision.
    """
    if len(joints) < 2:
        return tuple(joints)
    faces = sum(len(segment.faces) for segment in test.mesh.segments)
    shares = _combinations(len(joints), int(np.clip(MOST_MOVED // (faces * len(joints)), STATES // 8, STATES)))
    alone = np.array([joint.alone for joint in joints])
    ranges = alone.copy()
    tries = 0
    clean = False
    while not clean:
        clean = True
        for share in shares:
            tries += 1
            while blamed := _blamed(test, joints, share, ranges):
                clean = False
                tries += 1
                for joint, side in blamed:
                    way = float(f"{NARROWER * ranges[joint, side]:.2g}")
                    given_up = abs(way) < NARROWEST * abs(alone[joint, side]) or tries > MOST_PASSES * len(shares)
                    ranges[joint, side] = 0.0 if given_up else way
    narrow = [replace(joint, most=(float(a), float(b))) for joint, (a, b) in zip(joints, ranges, strict=True)]
    return tuple(joint for joint in narrow if joint.most[1] > joint.most[0])


def _combinations(joints: int, states: int) -> Float[ndarray, "states joints"]:
    """Shares of joints' ranges, -1 at the least and 1 at the most: corners, with some at rest, and random ones."""
    rng = default_rng(0)
    if 2**joints <= states // 2:
        corners = np.array(list(product((-1.0, 1.0), repeat=joints)))
    else:
        corners = rng.choice([-1.0, 1.0], (states // 2, joints))
    mixed = rng.choice([-1.0, 0.0, 1.0], (states // 4, joints))
    return np.concatenate([corners, mixed, rng.uniform(-1.0, 1.0, (states // 4, joints))])


def _blamed(
    test: _CollisionTest,
    joints: Sequence[Joint],
    share: Float[ndarray, " joints"],
    ranges: Float[ndarray, "joints 2"],
) -> set[Pair]:
    """Joints, and the side (0 for the least, 1 for the most) of their ranges, that bring segments into collision."""
    ways = (np.maximum(share, 0.0) * ranges[:, 1] + np.maximum(-share, 0.0) * ranges[:, 0]).tolist()
    return {
        (k, int(share[k] > 0))
        for pair in test.pairs(joints, ways)
        for k, joint in enumerate(joints)
        if ways[k] and len(set(pair) & set(joint.moved)) == 1
    }
