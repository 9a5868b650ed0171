"""Human: the MakeHuman body in ten parts, moved by its skeleton and skin weights, thin or stout, short or tall.

Source: MakeHuman's base mesh, default skeleton and default skin weights (MakeHuman community, CC0 1.0), through the
asset registry. The mouth is filled and eyeballs are put in, the body is simplified to 5,000 triangles, scaled to
40 x 67 x 17 units and cut by planes.

Segments: `torso` (with the neck's lower half), `head`, and of each side `upper_arm_left`, `forearm_left` (with the
hand), `thigh_left`, `shin_left` (with the foot). Left is the body's own left, +x; it faces +z, and y is up.

Degrees of freedom, in this order (angles from the rest pose, which is MakeHuman's: standing, arms away from the body,
elbows bent by 50 degrees):

- shape: height by up to 5 %, the width opposite so that the volume is kept; girth of the whole body by -10 to 14 %, and
  of trunk, arms and legs by 4 % more or less;
- pose: 16 joints at MakeHuman's places with 36 angles, uniform within their limits (``_human_joints``): waist and
  chest bend by 22 degrees forward, 10 back, 12 sideways, and twist by 15; neck and head nod and turn by 25; shoulders
  lift by 60 sideways and 65 forward; elbows bend by -40 to 58 and knees by 0 to 95, one way; hips flex by 62, extend by
  15, spread by 25; wrists bend by 35 and turn by 30, ankles bend by 30;
- smooth waves of all space (gradient up to 0.1).

A point takes part in a joint's turn by MakeHuman's skin weights, continued into the body (``_human_skin``). Poses in
which parts come through each other, or in which joints together press space below an eighth, are drawn again.

The camera stands in front of the body, as above a patient who lies on the back: head or feet may point anywhere.

What makes it hard: left and right are mirror images, which only the front tells apart; arms and hands are thin and hide
parts of the trunk or are hidden behind it.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mereo.deformation.draw_names import named, part, unchecked
from mereo.deformation.maps import Compose, Deformation, jacobian_determinant
from mereo.deformation.warps import SmoothField
from mereo.geometry.read_only import read_only
from mereo.geometry.solids import label_grid
from mereo.scenes.scene import Scene, Workspace
from mereo_objects._human_joints import JOINTS, NAMES, part_axes, rotations, turn_limits, turn_names
from mereo_objects._human_parts import SCALE, base, model_to_scene, rest_mesh, to_scene
from mereo_objects._human_skin import PosedBody, share_field

ATTEMPTS = 1000

APART = 3.2
"""Balls with at least this gap at rest are watched; closer ones touch or belong together, like both sides of a knee."""

LEAST_GAP = 0.5
"""That watched balls must keep: what lies between them and the skin is at most half of this deep."""

SMALLEST_BALL = 0.45
BARE = 0.7
"""Vertices farther than this from all balls, as of fingers, are balls without size."""

CRITICAL = 200
LEAST_DETERMINANT = 0.12

GIRTH_GROUPS = {
    "trunk": ("waist", "chest"),
    "arms": ("upper_arm.L", "forearm.L", "upper_arm.R", "forearm.R"),
    "legs": ("thigh.L", "shin.L", "thigh.R", "shin.R"),
}
"""Parts that are stout or thin together."""


class Balls(NamedTuple):
    """Balls that nearly fill the resting body, and how far apart their middles must be in any state (or -1)."""

    centers: Float[np.ndarray, "b 3"]
    apart: Float[np.ndarray, "b b"]


@cache
def balls() -> Balls:
    """Balls that touch the skin from within: the largest first, each with its middle outside of those before it."""
    rest = rest_mesh()
    axes = [np.arange(low, high, 0.6) for low, high in rest.bounds.T]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)[label_grid(rest, *axes) > 0]
    depth, _ = cKDTree(to_scene(base().vertices[np.unique(base().faces)])).query(nodes)
    centers, radii = np.empty((0, 3)), np.empty(0)
    for row in np.argsort(-depth, kind="stable"):
        if depth[row] < SMALLEST_BALL:
            break
        if not (np.linalg.norm(centers - nodes[row], axis=1) < radii + 0.4).any():
            centers = np.concatenate([centers, nodes[row : row + 1]])
            radii = np.append(radii, depth[row])
    for vertex in np.concatenate([segment.vertices for segment in rest.segments]):
        if (np.linalg.norm(centers - vertex, axis=1) - radii).min() > BARE:
            centers = np.concatenate([centers, vertex[None]])
            radii = np.append(radii, 0.0)
    touching = radii[:, None] + radii
    apart = np.where(cdist(centers, centers) - touching > APART, touching + LEAST_GAP, -1.0)
    return Balls(read_only(centers), read_only(apart))


def is_clear(posed: Deformation) -> bool:
    """Whether no part of the posed body meets another that it does not touch at rest."""
    centers, apart = balls()
    moved = posed(centers)
    return bool((cdist(moved, moved) > apart).all())


def keeps_space(posed: Deformation) -> bool:
    """Whether space is not folded over where the joints press it most."""
    return bool(jacobian_determinant(posed, critical_points()).min() > LEAST_DETERMINANT)


@cache
def critical_points() -> Float[np.ndarray, "n 3"]:
    """Vertices at which the joints can press space most: largest angle, slope of the share and lever multiply."""
    vertices = np.concatenate([segment.vertices for segment in rest_mesh().segments])
    field = share_field()
    step = 0.05 * np.eye(3)
    slope = np.stack([field(vertices + along) - field(vertices - along) for along in step], axis=2) / 0.1
    lever = np.linalg.norm(vertices[:, None] - part_axes()[1], axis=2)
    largest = np.abs(turn_limits()).max(axis=(0, 2))
    pressed = (np.linalg.norm(slope, axis=2) * lever * largest).max(axis=1)
    return read_only(vertices[np.argsort(-pressed, kind="stable")[:CRITICAL]])


def sample_body(rng: np.random.Generator) -> PosedBody:
    """Random shape in a random pose within the limits of each joint."""
    girth = np.zeros(len(JOINTS))
    with part(rng, "shape"):
        common = named(rng, "girth").uniform(-0.1, 0.14)
        for group, names in GIRTH_GROUPS.items():
            more = named(rng, f"girth of the {group}").uniform(-0.04, 0.04)
            girth[[NAMES.index(name) for name in names]] = common + more
    with part(rng, "pose"):
        pose = rotations(named(rng, turn_names(), "rad").uniform(*turn_limits()))
    with part(rng, "shape"):
        return PosedBody(pose, girth, float(np.exp(named(rng, "height", "log").uniform(-0.05, 0.05))))


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random shape, pose and waves, one map for all segments."""
    for _ in range(ATTEMPTS):
        body = sample_body(rng)
        if unchecked(rng) or (is_clear(body) and keeps_space(body)):
            with part(rng, "waves"):
                waves = SmoothField.sample(rng, named(rng, "strength").uniform(0.0, 0.1), (25.0, 60.0))
            return (Compose((body, waves)),) * len(rest_mesh().segments)
    raise ValueError(f"no pose in {ATTEMPTS} draws keeps the body's parts apart: narrow the joints' limits")


def scene() -> Scene:
    """Scene of the human body; needs the three assets `human/makehuman_*`."""
    return Scene(
        name="human",
        rest=rest_mesh(),
        sample_deformations=sample_deformations,
        workspace=Workspace(fov_rad=float(np.deg2rad(50.0))),
        source="MakeHuman base mesh, default skeleton and skin weights, MakeHuman community: CC0 1.0",
        unit_m=0.1 / SCALE,
        T_scene_source=model_to_scene().matrix,
    )
