"""Stanford Bunny: a soft toy in five parts, `body`, `head`, `ear_left`, `ear_right` and `tail`.

Source: the Stanford bunny (Stanford Computer Graphics Laboratory; research use, credit, not commercial), 6,966 faces,
watertight, through the asset registry. It is scaled so that its shortest side is 20 units and cut by planes into
closed segments.

What makes it hard: a nearly round body without landmarks, ears thin against the distance, a tail hidden from most
sides, and a camera that may look from anywhere (the whole sphere, any roll), because real scans come from all sides.
The workspace `cone` is that of the other scenes: from above, at most 70 degrees off, with a level horizon.
"""

from dataclasses import dataclass
from functools import cache

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, smooth_step, turn
from mereo.deformation.warps import SmoothField, Squash
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import Normalizer
from mereo.scenes.scene import WHOLE_SPHERE_RAD, Scene, Workspace
from mereo_objects import assets
from mereo_objects._solids import Vector

SHORTEST_SIDE = 20.0
LONGEST_EDGE = 1.2
"""Longer edges are split, so that the flat faces of the cuts bend with the rest."""


FOV_RAD = float(np.deg2rad(26.0))


@dataclass(frozen=True)
class Cut:
    """Plane through ``origin``; what lies beyond it along ``direction`` (within ``half``) becomes the segment."""

    origin: Vector
    direction: Vector
    half: float
    length: float


NECK = Cut((-7.0, 1.0, 3.0), (-0.40, 0.84, 0.33), half=40.0, length=40.0)
EAR_LEFT = Cut((-5.3, 7.0, 0.8), (0.69, 0.51, -0.51), half=4.0, length=12.0)
EAR_RIGHT = Cut((-8.8, 6.6, -1.6), (0.05, 0.50, -0.87), half=4.0, length=14.0)
TAIL = Cut((9.2, -9.3, 2.0), (0.945, -0.325, 0.0), half=5.0, length=9.0)


@cache
def model_to_scene() -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and scale of ``scene = (model - center) * scale``, which takes the metres of bunny.off to scene units."""
    vertices = _load().vertices
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    return read_only((low + high) / 2), float(SHORTEST_SIDE / (high - low).min())


@cache
def _load() -> trimesh.Trimesh:
    mesh = trimesh.load_mesh(assets.get("bunny/bunny.off"), process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@cache
def rest_mesh() -> SegmentedMesh:
    """Bunny at rest, cut into closed segments that share their cut faces."""
    mesh = _load()
    center, scale = model_to_scene()
    solid = manifold3d.Manifold(
        manifold3d.Mesh(((mesh.vertices - center) * scale).astype(np.float32), mesh.faces.astype(np.uint32))
    )
    # each cut keeps what lies inside a box that starts at a plane and points away from the body
    head, body = solid.split(_box(NECK))
    ear_left, head = head.split(_box(EAR_LEFT))
    ear_right, head = head.split(_box(EAR_RIGHT))
    tail, body = body.split(_box(TAIL))
    parts = {"body": body, "head": head, "ear_left": ear_left, "ear_right": ear_right, "tail": tail}
    return SegmentedMesh(tuple(_segment(name, part, PALETTE[i]) for i, (name, part) in enumerate(parts.items())))


def _box(cut: Cut) -> manifold3d.Manifold:
    """The box whose first face is centred at the cut's origin, perpendicular to its direction."""
    z = np.array(cut.direction) / np.linalg.norm(cut.direction)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    pose = np.stack([x, np.cross(z, x), z, np.array(cut.origin)], axis=1)
    cube = manifold3d.Manifold.cube((2 * cut.half, 2 * cut.half, cut.length))
    return cube.translate((-cut.half, -cut.half, 0.0)).transform(pose)


def _segment(name: str, part: manifold3d.Manifold, color: tuple[int, int, int]) -> Segment:
    mesh = part.refine_to_length(LONGEST_EDGE).to_mesh()
    vertices = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    return Segment(name, color, vertices, np.array(mesh.tri_verts, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class SoftJoint:
    """Rotation that grows from nothing at a plane to its full angle ``length`` beyond it; the other side stays.

    A point at height s above the plane (along ``direction``, through ``center``) turns about ``center`` by
    ``rotation_vector * w(s / length)``, w the quintic step. The Jacobian stays positive while the angle times the
    distance from the axis is less than about half of ``length``: the bounds below keep it so, and a test measures it.
    """

    center: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    length: float
    rotation_vector: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Images of points, in scene units."""
        height = (points - self.center) @ self.direction
        angle_rad = float(np.linalg.norm(self.rotation_vector))
        axis = self.rotation_vector / max(angle_rad, 1e-12)
        return turn(points, self.center, axis, angle_rad * smooth_step(height / self.length))


@dataclass(frozen=True)
class JointBounds:
    """Bounds of a joint: its plane, the length of its soft zone, and its largest rotation in radians."""

    center: Vector
    direction: Vector
    length: float
    twist_rad: float
    bend_rad: float

    def sample(self, rng: np.random.Generator) -> SoftJoint:
        """Random joint: a twist about ``direction`` and a bend about a random axis across it, each within its bound."""
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        across = np.cross(direction, named(rng, "bend about").normal(size=3))
        across /= np.linalg.norm(across)
        bend = across * named(rng, "bend", "rad").uniform(0.0, self.bend_rad)
        twist = direction * named(rng, "twist", "rad").uniform(-self.twist_rad, self.twist_rad)
        return SoftJoint(np.array(self.center), direction, self.length, bend + twist)


def _beyond(cut: Cut, distance: float) -> Vector:
    """The point on the cut's axis this far beyond its plane."""
    x, y, z = np.array(cut.origin) + distance * np.array(cut.direction) / np.linalg.norm(cut.direction)
    return (float(x), float(y), float(z))


# distal joints first: each is evaluated in the rest pose of what it moves
EAR_LEFT_JOINTS = {
    "tip": JointBounds(_beyond(EAR_LEFT, 4.0), EAR_LEFT.direction, length=5.0, twist_rad=0.35, bend_rad=0.7),
    "root": JointBounds(EAR_LEFT.origin, EAR_LEFT.direction, length=5.0, twist_rad=0.35, bend_rad=0.6),
}
EAR_RIGHT_JOINTS = {
    "tip": JointBounds(_beyond(EAR_RIGHT, 4.0), EAR_RIGHT.direction, length=5.0, twist_rad=0.35, bend_rad=0.7),
    "root": JointBounds(EAR_RIGHT.origin, EAR_RIGHT.direction, length=5.0, twist_rad=0.35, bend_rad=0.6),
}
HEAD_JOINT = JointBounds(NECK.origin, NECK.direction, length=9.0, twist_rad=0.45, bend_rad=0.25)
TAIL_JOINT = JointBounds(TAIL.origin, TAIL.direction, length=4.0, twist_rad=0.15, bend_rad=0.2)
SPINE_JOINT = JointBounds((-10.0, -4.0, 2.0), (1.0, 0.0, 0.0), length=24.0, twist_rad=0.35, bend_rad=0.35)


def _joint(rng: np.random.Generator, name: str, bounds: JointBounds) -> SoftJoint:
    with part(rng, name):
        return bounds.sample(rng)


def _ear(rng: np.random.Generator, name: str, joints: dict[str, JointBounds]) -> list[Deformation]:
    with part(rng, name):
        return [_joint(rng, place, bounds) for place, bounds in joints.items()]


def squash_and_wobble(rng: np.random.Generator) -> list[Deformation]:
    """Random squeeze by up to 18 percent at constant volume, then smooth random waves."""
    squash_along = named(rng, "squash along").normal(size=3)
    squash = Squash(np.zeros(3), squash_along, float(np.exp(named(rng, "squash", "log").uniform(-0.18, 0.18))))
    frequencies = named(rng, "wave directions").normal(size=(4, 3))
    wavelengths = named(rng, "wavelength").uniform(25.0, 45.0, size=(4, 1))
    frequencies *= 2 * np.pi / wavelengths / np.linalg.norm(frequencies, axis=1, keepdims=True)
    amplitudes = named(rng, "wave motions").normal(size=(4, 3))
    amplitudes *= (
        named(rng, "wave strength").uniform(0.0, 0.3 / 4)
        / np.linalg.norm(frequencies, axis=1).max()
        / np.linalg.norm(amplitudes, axis=1, keepdims=True)
    )
    phases = named(rng, "wave phase", "rad").uniform(0, 2 * np.pi, size=4)
    return [squash, SmoothField(amplitudes, frequencies, phases)]


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random maps, one per segment: ears, head and tail turn softly from their cuts on, then the body deforms.

    A joint leaves its own plane where it is, so neighbours stay in contact along the cut.
    """
    ear_left, ear_right = _ear(rng, "left ear", EAR_LEFT_JOINTS), _ear(rng, "right ear", EAR_RIGHT_JOINTS)
    head, tail = _joint(rng, "head", HEAD_JOINT), _joint(rng, "tail", TAIL_JOINT)
    spine = _joint(rng, "spine", SPINE_JOINT)
    with part(rng, "body"):
        body = [*squash_and_wobble(rng), spine]
    chains = (body, [head, *body], [*ear_left, head, *body], [*ear_right, head, *body], [tail, *body])
    return tuple(Compose(tuple(chain)) for chain in chains)


def scene() -> Scene:
    """Scene of the Stanford Bunny; needs the asset `bunny/bunny.off`."""
    return Scene(
        name="bunny",
        rest=rest_mesh(),
        sample_deformations=sample_deformations,
        workspace=Workspace(aperture_rad=WHOLE_SPHERE_RAD, any_roll=True, fov_rad=FOV_RAD),
        cone=Workspace(axis=(0.0, 1.0, 0.0), fov_rad=FOV_RAD),
        source="Stanford Computer Graphics Laboratory, Stanford 3D Scanning Repository: research use, not commercial",
        unit_m=1 / model_to_scene()[1],
        T_scene_source=Normalizer(*model_to_scene()).matrix,
    )
