"""The MakeHuman body: read, made solid and simpler, scaled, and cut into closed segments that share their cut faces.

Model coordinates are MakeHuman's: decimetres, x to the body's left, y up, z to its front. Scene coordinates have the
same axes, with the middle of the body's box at the origin.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float, Int

from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.mesh_check import mesh_of, solid_of
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import Normalizer
from mereo_objects import assets
from mereo_objects._real_meshes import simplified
from mereo_objects._solids import Vector, segment_of

SCALE = 4.0
"""Scene units per decimetre: the body is 17 units deep, 40 wide and 67 tall."""

FACES = 5000
"""Triangles to which the body's 26,756 triangles are simplified before it is cut."""

LONGEST_EDGE = 3.6
"""Longer edges are split, so that the flat cut faces bend with the rest."""

MOUTH = ((-0.37, 6.23, 0.5), (0.37, 7.0, 1.44))
"""Box that holds the mouth's inner surface, and no skin but some under the chin."""

EYE = (0.308, 7.284, 1.245)
EYE_RADIUS = 0.146
"""The left eyeball, which is not in the group `body` (centre and size of MakeHuman's `helper-l-eye`)."""


@dataclass(frozen=True)
class Wedge:
    """Part of space on the positive side of every plane (a point, a normal); model coordinates."""

    planes: tuple[tuple[Vector, Vector], ...]

    def mirrored(self) -> "Wedge":
        """Wedge on the other side of the body."""
        return Wedge(tuple(((-p[0], p[1], p[2]), (-n[0], n[1], n[2])) for p, n in self.planes))

    def solid(self) -> manifold3d.Manifold:
        """Solid of the wedge, as much of it as holds any part of the body, in scene coordinates."""
        solid = manifold3d.Manifold.cube((200.0, 200.0, 200.0), True)
        for point, normal in self.planes:
            origin = to_scene(np.array([point]))[0]
            solid = solid.trim_by_plane(normal, float(origin @ normal / np.linalg.norm(normal)))
        return solid


ARMPIT, CROTCH, ELBOW, KNEE = (1.62, 4.42, 0.1), (0.0, -0.47, 0.1), (3.13, 3.49, 0.13), (1.58, -3.69, 0.32)
HEAD = Wedge((((0.0, 6.1, 0.3), (0.0, 0.95, 0.3)),))
# the first plane goes through shoulder and armpit, the second between arm and flank, through the air
ARM = Wedge(((ARMPIT, (0.99, 0.13, 0.0)), (ARMPIT, (0.915, 0.4, 0.0))))
FOREARM = Wedge(((ELBOW, (0.6, -0.63, 0.4)),))
# the first plane goes along the groin, the second keeps off the other leg
LEG = Wedge(((CROTCH, (0.61, -0.79, 0.0)), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
SHIN = Wedge(((KNEE, (0.16, -0.98, -0.03)),))


@dataclass(frozen=True, eq=False)
class Base:
    """MakeHuman's base mesh in model coordinates.

    Attributes:
        vertices: all of them, also those of helpers, to which the skeleton's joints refer.
        faces: triangles of the body alone.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


@cache
def base() -> Base:
    """Base mesh of the asset `human/makehuman_base.obj`."""
    rows: list[list[float]] = []
    quads: list[list[int]] = []
    group = ""
    for line in assets.get("human/makehuman_base.obj").read_text("utf-8").splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            rows.append([float(word) for word in rest.split()])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f" and group == "body":
            quads.append([int(word.partition("/")[0]) - 1 for word in rest.split()])
    corners = np.array(quads, dtype=np.int64)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return Base(read_only(np.array(rows)), read_only(faces))


@cache
def model_to_scene() -> Normalizer:
    """Map from model to scene coordinates, which takes the middle of the body's box to the origin."""
    body = base().vertices[base().faces.ravel()]
    return Normalizer(read_only((body.min(axis=0) + body.max(axis=0)) / 2), SCALE)


def to_scene(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points from model to scene coordinates."""
    return model_to_scene().apply(points)


@cache
def joints() -> Mapping[str, Float[np.ndarray, "3"]]:
    """Heads and tails of the bones by MakeHuman's names (``upperarm01.L____head``), in scene coordinates."""
    skeleton = json.loads(assets.get("human/makehuman_default.mhskel").read_bytes())
    places: dict[str, list[int]] = skeleton["joints"]
    middles = {name: base().vertices[rows].mean(axis=0, keepdims=True) for name, rows in places.items()}
    return {name: read_only(to_scene(middle)[0]) for name, middle in middles.items()}


@cache
def skin_weights() -> Mapping[str, tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]]:
    """Base vertices that each bone moves, and its share in each."""
    stored: dict[str, list[Any]] = json.loads(assets.get("human/makehuman_default_weights.mhw").read_bytes())["weights"]
    weights = {}
    for bone, pairs in stored.items():
        rows, shares = zip(*pairs, strict=True)
        weights[bone] = read_only(np.array(rows, dtype=np.int64)), read_only(np.array(shares, dtype=np.float64))
    return weights


@cache
def rest_mesh() -> SegmentedMesh:
    """Body as MakeHuman stores it: standing, arms away from the body, in ten segments."""
    head, torso = _body().split(HEAD.solid())
    limbs: dict[str, manifold3d.Manifold] = {}
    for side in ("left", "right"):
        arm, leg, forearm, shin = (w if side == "left" else w.mirrored() for w in (ARM, LEG, FOREARM, SHIN))
        upper, torso = torso.split(arm.solid())
        limbs[f"forearm_{side}"], limbs[f"upper_arm_{side}"] = upper.split(forearm.solid())
        lower, torso = torso.split(leg.solid())
        limbs[f"shin_{side}"], limbs[f"thigh_{side}"] = lower.split(shin.solid())
    order = [f"{part}_{side}" for part in ("upper_arm", "forearm", "thigh", "shin") for side in ("left", "right")]
    parts = {"torso": torso, "head": head, **{name: limbs[name] for name in order}}
    return SegmentedMesh(
        tuple(
            segment_of(name, PALETTE[i], part.refine_to_length(LONGEST_EDGE))
            for i, (name, part) in enumerate(parts.items())
        )
    )


def _body() -> manifold3d.Manifold:
    """The whole body, mouth filled and eyes put in, simplified by quadric edge collapses (Garland & Heckbert 1997)."""
    mesh = base()
    solid = solid_of(mesh.vertices[: mesh.faces.max() + 1], mesh.faces)
    low, high = np.array(MOUTH)
    mouth = mesh.vertices[np.unique(mesh.faces)]
    mouth = mouth[((mouth > low) & (mouth < high)).all(axis=1)]
    solid += manifold3d.Manifold.hull_points(mouth.astype(np.float32))
    for side in (1.0, -1.0):
        solid += manifold3d.Manifold.sphere(EYE_RADIUS, 24).translate((side * EYE[0], EYE[1], EYE[2]))
    outer = max(solid.decompose(), key=lambda part: part.volume())  # the others are voids behind the lips
    vertices, faces = mesh_of(outer)
    return simplified(solid_of(to_scene(vertices), faces), FACES, block_intersections=True)
