"""Liver and gallbladder for the scenes ``liver`` and ``tumor``: repaired meshes, and the one field that moves them.

Sizes are stated in millimetres of the source; ``MM`` takes them to scene units.
"""

from functools import cache
from typing import NamedTuple

import manifold3d
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, Localized, Rigid
from mereo.deformation.warps import Bend, FreeFormLattice, Squash, Twist
from mereo.geometry.mesh import PALETTE, AnyFaces, Segment, vertex_normals
from mereo.geometry.mesh_check import solid_of
from mereo.geometry.mesh_repair import close_holes, largest_piece
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import AnyPoints, Normalizer
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.scene import Workspace
from mereo_objects import assets
from mereo_objects._real_meshes import main_part, simplified
from mereo_objects._solids import segment_of

SHORTEST_SIDE = 20.0
SHORTEST_SIDE_MM = 162.68
MM = SHORTEST_SIDE / SHORTEST_SIDE_MM
"""Scene units per millimetre."""

UNIT_M = 0.001 / MM

CENTER_MM = (-3.333, -3.867, 0.0)
"""Middle of the liver's box in the frame of the source."""

PLACEMENT = Normalizer(read_only(np.array(CENTER_MM)), MM)
"""Map from the source's frame in millimetres to the scene's."""

LIVER_FACES, GALLBLADDER_FACES = 5000, 2000
"""The source has 28,560 and 14,700; this many keep the surface to within 0.01 and 0.1 mm, before the cut."""

LONGEST_EDGE_MM = 14.0

SOURCE = "LapGym (sofa_env), (c) 2023 Paul Scheikl, MIT licence"

WORKSPACE = Workspace(axis=(-0.05, -0.6, -0.8), fov_rad=float(np.deg2rad(22.0)))
"""Above the visceral surface, on which the gallbladder lies: what a laparoscope sees once the liver is lifted."""


def repaired_liver() -> tuple[AnyPoints, AnyFaces]:
    """Largest piece of the liver with its open loop closed, millimetres: 28,560 faces, 1,762 cubic centimetres."""
    raw = read_segmented_mesh(assets.get("liver/lapgym_liver_visual.stl")).segments[0]
    return close_holes(*largest_piece(raw.vertices, raw.faces))


def to_scene(points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points from the source's frame in millimetres to the scene's."""
    return PLACEMENT.apply(points_mm)


@cache
def organs() -> tuple[Segment, Segment]:
    """Liver and gallbladder at rest. The gallbladder owns the sliver (2 % of it) in which the meshes overlap."""
    vertices, faces = repaired_liver()
    liver = simplified(solid_of(to_scene(vertices), faces), LIVER_FACES)
    raw = read_segmented_mesh(assets.get("liver/lapgym_gallbladder_visual.stl")).segments[0]
    gallbladder = simplified(solid_of(to_scene(raw.vertices), raw.faces), GALLBLADDER_FACES)
    return _segment("liver", 4, main_part(liver - gallbladder)), _segment("gallbladder", 2, gallbladder)


def _segment(name: str, color: int, solid: manifold3d.Manifold) -> Segment:
    return segment_of(name, PALETTE[color], solid.refine_to_length(LONGEST_EDGE_MM * MM))


# --- the field --------------------------------------------------------------------------------------------------------


class Instrument(NamedTuple):
    """Instrument and what it does to the tissue around its tip.

    Attributes:
        shift_mm: least and most displacement of the tip; along the outward normal, or against it where negative.
        tip_mm: all tissue within this distance moves with the tip.
        reach_mm: beyond this distance nothing moves. The map's Jacobian is at least 1 - 15/8 shift / (reach - tip).
    """

    shift_mm: tuple[float, float]
    tip_mm: float
    reach_mm: float

    def sample(self, rng: np.random.Generator, tip: AnyPoints, normal: AnyPoints) -> Localized:
        """Random pull at one of the given places, within 30 degrees of its normal or so."""
        index = named(rng, "place").integers(len(tip))
        direction = normal[index] + 0.35 * named(rng, "slant").normal(size=3)
        direction *= named(rng, "shift", "mm").uniform(*self.shift_mm) * MM / np.linalg.norm(direction)
        pull = Rigid(np.zeros(3), direction, tip[index])
        return Localized(pull, tip[index], self.tip_mm * MM, self.reach_mm * MM)


GRASPER = Instrument((10.0, 32.0), tip_mm=14.0, reach_mm=94.0)
RETRACTOR = Instrument((5.0, 16.0), tip_mm=14.0, reach_mm=80.0)
PROBE = Instrument((-16.0, -5.0), tip_mm=8.0, reach_mm=70.0)

INSTRUMENTS = {"grasper": ("edge", GRASPER), "retractor": ("gallbladder", RETRACTOR), "probe": ("surface", PROBE)}
"""Where each may be, and what it does there."""

BEND_RAD, TWIST_RAD, SQUASH = 0.5, 0.6, 0.12
LATTICE_CELLS = (3, 3, 3)
LATTICE_STRENGTH = 0.4

EDGE_SHARE = 0.12
"""A grasper holds the liver by the sharpest part of its vertices."""


@cache
def _places() -> dict[str, tuple[AnyPoints, AnyPoints]]:
    """Places where each kind of instrument may be, with outward normals."""
    liver, gallbladder = organs()
    normals = [read_only(vertex_normals(part)) for part in (liver, gallbladder)]
    tree = cKDTree(liver.vertices)
    around = tree.query_ball_point(liver.vertices, 25.0 * MM)
    mean = np.stack([liver.vertices[rows].mean(axis=0) for rows in around])
    # on an edge the surroundings lie far below the surface
    height = np.einsum("ni,ni->n", normals[0], liver.vertices - mean)
    edge = height > np.quantile(height, 1 - EDGE_SHARE)
    return {
        "edge": (read_only(liver.vertices[edge]), read_only(normals[0][edge])),
        "gallbladder": (gallbladder.vertices, normals[1]),
        "surface": (liver.vertices, normals[0]),
    }


def sample_field(rng: np.random.Generator) -> Compose:
    """Random deformation of all tissue: instruments first, then posture and breathing."""
    places = _places()
    names = tuple(INSTRUMENTS)
    order = named(rng, tuple(f"order of the {name}" for name in names)).permutation(3)
    instruments: list[Deformation] = []
    for index in order[: named(rng, "instruments").integers(0, 4)]:
        place, tool = INSTRUMENTS[names[index]]
        with part(rng, names[index]):
            instruments.append(tool.sample(rng, *places[place]))
    with part(rng, "posture"):
        return Compose((*instruments, *_posture(rng)))


def _posture(rng: np.random.Generator) -> list[Deformation]:
    """Bend and twist along the longest axis, flattening, and smooth random waves of the whole organ."""
    liver, _ = organs()
    low, high = liver.bounds
    length = float(high[1] - low[1])
    end, axis = np.array([0.0, low[1], 0.0]), np.array([0.0, 1.0, 0.0])
    toward = np.array([named(rng, "bend toward x").normal(), 0.0, named(rng, "bend toward z").normal()])
    radius = float(np.linalg.norm(liver.vertices[:, [0, 2]], axis=1).max())
    lattice = FreeFormLattice.sample(rng, liver.bounds, LATTICE_CELLS, LATTICE_STRENGTH)
    squash_along = named(rng, "squash along").normal(size=3)
    squash = Squash(np.zeros(3), squash_along, float(np.exp(named(rng, "squash", "log").uniform(-SQUASH, SQUASH))))
    twist = Twist(end, axis, length, named(rng, "twist", "rad").uniform(-TWIST_RAD, TWIST_RAD))
    bend_rad = named(rng, "bend", "rad").uniform(-BEND_RAD, BEND_RAD)
    return [lattice, squash, twist, Bend(end, axis, toward, length, bend_rad, 1.3 * radius)]
