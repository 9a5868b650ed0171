"""Tumor: a lobulated tumour inside the liver, with the gallbladder: the nested scene (docs/method.md).

Source: liver and gallbladder as in the scene `liver` (LapGym, MIT, (c) 2023 Paul Scheikl); the tumour is modelled here:
eleven lobes, 40 mm across, 22 cubic centimetres, at least 22 mm below the liver's surface.

Segments: `tumor`, `liver` and `gallbladder`. `tumor` is declared nested in `liver`: it owns what is inside it, and
`liver` the rest of what its mesh holds.

Degrees of freedom: those of the scene `liver`, by one field for all three. Before it, the tumour and the tissue around
it are moved by another map of space, so that the tumour's place varies by up to 4 mm in any direction and its diameter
by up to 15 percent; within 22 mm of its centre that is a similarity, beyond 46 mm nothing moves.

What makes it hard: no camera ever sees the tumour. Its place follows from the deformation of the visible surface alone,
and what varies by itself cannot be known: at best the mean.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from jaxtyping import Float

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, Localized
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.scenes.scene import Scene
from mereo_objects._liver_parts import MM, PLACEMENT, SOURCE, UNIT_M, WORKSPACE, organs, sample_field, to_scene

CENTER_MM = (-18.7, 24.0, 57.0)
"""In the source's frame; the liver's deepest point, 41 mm from its surface, is near."""

LOBES = 11
LOBE_OFFSET_MM, LOBE_RADIUS_MM = (6.5, 9.5), (9.0, 12.0)

SHIFT_MM, GROWTH = 4.0, 0.15
"""Bounds of the tumour's random place and size at rest."""

TISSUE_MM = (22.0, 46.0)
"""Within the first radius tissue moves with the tumour, beyond the second not at all. The displacement in between is at
most 4 + 0.15 * 46 mm; the Jacobian was at least 0.40 in 300 draws, and the liver's surface moved by 0.5 mm at most."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Scaling by ``factor`` > 0 about ``center``, then a shift."""

    center: Float[np.ndarray, "3"]
    factor: float
    shift: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points after the motion."""
        return self.center + self.shift + self.factor * (points - self.center)


def _center() -> Float[np.ndarray, "3"]:
    return to_scene(np.array([CENTER_MM]))[0]


def _lobulated() -> Segment:
    """The smooth union of balls around a centre that all of them hold, so that it is a radius over directions."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    golden = (np.arange(LOBES) + 0.5) * np.pi * (3 - np.sqrt(5))
    height = 1 - 2 * (np.arange(LOBES) + 0.5) / LOBES
    across = np.sqrt(1 - height**2)
    toward = np.stack([across * np.cos(golden), across * np.sin(golden), height], axis=1)
    share = (np.arange(LOBES) * 0.618034) % 1.0
    offset, size = (low + share * (high - low) for low, high in (LOBE_OFFSET_MM, LOBE_RADIUS_MM))
    along = offset * (sphere.vertices @ toward.T)
    reach = along + np.sqrt(size**2 - offset**2 + along**2)  # to where the ray leaves each ball
    radius = np.log(np.exp(2.0 * reach).sum(axis=1)) / 2.0
    vertices = _center() + MM * radius[:, None] * np.asarray(sphere.vertices)
    return Segment("tumor", PALETTE[3], vertices, np.array(sphere.faces, dtype=np.int64))


@cache
def rest_mesh() -> SegmentedMesh:
    """Tumour, liver and gallbladder at rest."""
    return SegmentedMesh((_lobulated(), *organs()), nested=(("tumor", "liver"),))


def sample_placement(rng: np.random.Generator) -> Localized:
    """Random place and size of the tumour, uniform in a ball and in diameter; the liver's surface stays."""
    with part(rng, "tumor"):
        direction = named(rng, "shift toward").normal(size=3)
        shift = direction / np.linalg.norm(direction) * SHIFT_MM * MM * named(rng, "shift").uniform() ** (1 / 3)
        similarity = Similarity(_center(), named(rng, "size").uniform(1 - GROWTH, 1 + GROWTH), shift)
    return Localized(similarity, _center(), TISSUE_MM[0] * MM, TISSUE_MM[1] * MM)


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random map for all three: the tumour's placement, then the liver's field."""
    placed = sample_placement(rng)
    field = Compose((placed, *sample_field(rng).parts))
    return (field, field, field)


def scene() -> Scene:
    """Scene of the tumour in the liver; needs the same assets as the scene `liver`."""
    source = f"{SOURCE}; the tumour is modelled in mereo"
    T = PLACEMENT.matrix
    return Scene("tumor", rest_mesh(), sample_deformations, WORKSPACE, source, unit_m=UNIT_M, T_scene_source=T)
