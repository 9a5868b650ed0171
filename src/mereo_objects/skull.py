"""Skull: a cranium with its upper teeth, and a mandible with its lower teeth that opens, slides and chews.

Source: `skull_and_teeth_coarse.obj` of the SOFA framework (LGPL-2.1-or-later): cranium, mandible and 32 teeth as closed
parts, through the asset registry, scaled so that the shortest side (left to right) is 20 units (1 unit is about 8 mm);
the skull lies on its back: x is toward the crown, y to its right, z forward (up). As in the source, the braincase is
filled.

Segments: `upper_teeth` and `lower_teeth` (16 each, crowns and roots), `cranium` and `mandible`, from which the roots
are cut: teeth own what they share with bone. The source shows the mouth open, the jaw's joints pushed into the skull
and the lower teeth beside their bone; here the lower teeth are seated in it and the jaw is closed, both by a rigid
motion (`SEAT`, `CLOSE`). At rest nothing of the jaw is nearer than 0.1 units (1 mm) to the skull.

Degrees of freedom: the jaw turns about the axis through both condyles by 0 to 28 degrees, which glide forward by up to
1 unit (8 mm) and down by 0.35 on the way. From 0 to 6 degrees on it also shifts forward by up to 0.7 units (6 mm)
and turns about the condyle of either side by up to 4.5 degrees (the chin moves 1 unit, 8 mm, to that side), both less
again as the mouth opens wide. One rigid map moves mandible and lower teeth; the cranium and its teeth stay.

What makes it hard: teeth are small against the distance and hide each other, rows of them nearly repeat, the skull is
nearly symmetric from left to right, and from behind or above the jaw is out of sight.
"""

from dataclasses import dataclass
from functools import cache

import manifold3d
import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, Identity, Rigid
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.mesh_check import solid_of
from mereo.geometry.mesh_repair import close_holes, largest_piece
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import rigid
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.scene import Scene, Workspace
from mereo_objects import assets
from mereo_objects._real_meshes import main_part, simplified
from mereo_objects._solids import Vector, segment_of, union

UNITS = 3.2342
"""Scene units per unit of the source, where the skull is 6.184 wide."""

UNIT_M = 0.008
"""The source gives no size; so, the skull is 16 cm wide, as an adult's."""

SOURCE_AXES = read_only(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
"""Rotation from the source's axes to the scene's."""

CENTER = (7.825, -0.298, 0.237)
"""Middle of the skull's box in scene units, before it is moved to the origin."""

FACES = {"skull_bone": 2600, "jaw_bone_j": 1100}
TOOTH_FACES = 84
"""Fewer than in the source (3,690, 1,450 and 80 to 232): moves nearly all of the surface by less than 0.07 units."""


@dataclass(frozen=True)
class Fit:
    """Rigid motion that was fitted once: turn about ``center`` by ``rotation_rad`` (axis times angle), then shift."""

    center: Vector
    rotation_rad: Vector
    shift: Vector

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points after the motion."""
        return Rigid(np.array(self.rotation_rad), np.array(self.shift), np.array(self.center))(points)


SEAT = Fit((-3.493, 0.331, 8.069), (0.0434, -0.1474, 0.0008), (0.1938, -0.3709, 0.1674))
"""Of the lower teeth into the mandible: the smallest motion that has all roots in the bone."""

CLOSE = Fit((3.493, -0.162, 1.455), (-0.0076, 0.5850, -0.0082), (-0.64, 0.03, 0.24))
"""Of the mandible: the cusps of its teeth come as near to the upper teeth as they can without touching, and its joints
leave the skull."""


# --- the jaw's joint --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Condyles:
    """Condyles of the jaw at rest: the middles of its joints' heads on its right (+y) and left (-y)."""

    right: Float[np.ndarray, "3"]
    left: Float[np.ndarray, "3"]


OPEN_RAD = float(np.deg2rad(28.0))
GLIDE = (-0.35, 0.0, 1.0)
"""Of the condyles when the mouth is wide open, in proportion before."""

PROTRUSION = 0.7
LATERAL_RAD = float(np.deg2rad(4.5))
DISENGAGED_RAD = float(np.deg2rad(6.0))
"""From here on the teeth are far enough apart for the jaw to slide fully."""


def jaw_motion(condyles: Condyles, open_rad: float, protrusion: float, lateral_rad: float) -> Compose:
    """Motion of the jaw: opening about the hinge with its glide, a slide forward, a turn about an axis in one condyle.

    Args:
        condyles: their places at rest.
        open_rad: 0 (closed) to ``OPEN_RAD``.
        protrusion: forward, in units.
        lateral_rad: positive turns the chin to the skull's left, about the left condyle.
    """
    axis = condyles.left - condyles.right
    hinge = open_rad * axis / np.linalg.norm(axis)
    slide = open_rad / OPEN_RAD * np.array(GLIDE) + np.array([0.0, 0.0, protrusion])
    pivot = (condyles.left if lateral_rad > 0 else condyles.right) + slide
    return Compose(
        (
            Rigid(hinge, slide, (condyles.left + condyles.right) / 2),
            Rigid(np.array([lateral_rad, 0.0, 0.0]), np.zeros(3), pivot),
        )
    )


def jaw_state(opening: float, forward: float, side: float) -> tuple[float, float, float]:
    """Opening angle, protrusion and lateral angle from shares: of the opening, and of what it leaves free.

    Closed teeth hold the jaw, and so do its ligaments when the mouth is wide open: Posselt's envelope, roughly.

    Args:
        opening: 0 to 1.
        forward: 0 to 1.
        side: -1 to 1.
    """
    open_rad = opening * OPEN_RAD
    free = min(1.0, open_rad / DISENGAGED_RAD) * (1.0 - 0.6 * opening)
    return open_rad, free * forward * PROTRUSION, free * side * LATERAL_RAD


def sample_jaw(rng: np.random.Generator) -> tuple[float, float, float]:
    """Random ``jaw_state``; one mouth in seven is closed."""
    with part(rng, "mandible"):
        opening = 0.0 if named(rng, "closed below 1/7").uniform() < 1 / 7 else named(rng, "opening").uniform()
        return jaw_state(opening, named(rng, "forward").uniform(), named(rng, "to its left").uniform(-1.0, 1.0))


# --- the model --------------------------------------------------------------------------------------------------------


@cache
def _source() -> dict[str, Segment]:
    """The parts by their short name (`skull_bone`, `jaw_bone_j`, `ucaninel_f` and so on), in scene units and axes."""
    parts = read_segmented_mesh(assets.get("skull/sofa_skull_and_teeth_coarse.obj")).segments
    short = [part.name.split(":")[2].split()[0] for part in parts]
    return {
        name: Segment(name, part.color, UNITS * part.vertices @ SOURCE_AXES.T, part.faces)
        for name, part in zip(short, parts, strict=True)
    }


def _solid(name: str) -> manifold3d.Manifold:
    """A part without the source's six stray triangles, and with the cranium's one missing triangle; simplified."""
    part = _source()[name]
    whole = solid_of(*close_holes(*largest_piece(part.vertices, part.faces)))
    return simplified(whole, FACES.get(name, TOOTH_FACES))


def _teeth(row: str) -> manifold3d.Manifold:
    return union(*(_solid(name) for name in _source() if name.startswith(row)))


@cache
def rest_mesh() -> SegmentedMesh:
    """Skull with its mouth closed."""
    upper = _teeth("u")
    cranium = _solid("skull_bone")
    lower = _moved(_teeth("l"), SEAT)
    mandible = _solid("jaw_bone_j")
    solids = {
        "upper_teeth": upper,
        "cranium": main_part(cranium - upper),
        "lower_teeth": _moved(lower, CLOSE),
        "mandible": _moved(main_part(mandible - lower), CLOSE),
    }
    colors = (PALETTE[0], PALETTE[3], PALETTE[2], PALETTE[1])
    return SegmentedMesh(
        tuple(
            segment_of(name, color, solid.translate((-CENTER[0], -CENTER[1], -CENTER[2])))
            for color, (name, solid) in zip(colors, solids.items(), strict=True)
        )
    )


def _moved(solid: manifold3d.Manifold, motion: Fit) -> manifold3d.Manifold:
    corner = motion(np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    return solid.transform(np.concatenate([(corner[1:] - corner[0]).T, corner[:1].T], axis=1))


@cache
def condyles() -> Condyles:
    """Condyles found on the mandible: of each side what is near its highest point behind the notch."""
    vertices = _source()["jaw_bone_j"].vertices
    heads = []
    for side in (1.0, -1.0):
        behind = vertices[(side * vertices[:, 1] > 0) & (vertices[:, 2] < 2.5)]
        head = behind[behind[:, 0] > behind[:, 0].max() - 1.4]
        heads.append(CLOSE((head.min(axis=0) + head.max(axis=0))[None] / 2)[0] - np.array(CENTER))
    return Condyles(*heads)


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random rigid motion of mandible and lower teeth; the cranium stays."""
    still = Identity()
    jaw = jaw_motion(condyles(), *sample_jaw(rng))
    return (still, still, jaw, jaw)


def scene() -> Scene:
    """Scene of the skull; needs `skull/sofa_skull_and_teeth_coarse.obj`. The camera is in front of the face."""
    return Scene(
        name="skull",
        rest=rest_mesh(),
        sample_deformations=sample_deformations,
        workspace=Workspace(fov_rad=float(np.deg2rad(22.0))),
        source="SOFA framework, LGPL-2.1-or-later; teeth seated and jaw closed by mereo",
        unit_m=UNIT_M,
        T_scene_source=rigid(UNITS * SOURCE_AXES, -np.array(CENTER)),
    )
