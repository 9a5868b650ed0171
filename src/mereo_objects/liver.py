"""Liver & Gallbladder: two organs in contact, deformed as one soft body by breathing and by instruments.

Source: liver and gallbladder of LapGym (sofa_env, MIT, (c) 2023 Paul Scheikl; 163 x 202 x 198 mm and 90 x 57 x 51 mm,
one frame) through the asset registry, scaled so that the shortest side is 20 units (1 unit is 8.1 mm). The liver's mesh
is repaired here: stray fragments are dropped and its one open loop is closed. It is then simplified, and the sliver in
which both overlap (0.8 cubic centimetres, 2 % of the gallbladder) is cut from the liver.

Segments: `liver` and `gallbladder`. One map moves both, so they stay in contact.

Degrees of freedom, all random: a bend along the longest axis by up to 29 degrees to any side and a twist by up to 34
degrees (posture, mobilization), flattening by up to 12 percent at constant volume, and smooth waves of the whole organ
(a lattice of 54 to 67 mm whose nodes move up to 11 mm along each axis). Then none to all of three instruments: a
grasper lifts an edge of the liver by 10 to 32 mm (tissue within 94 mm follows), a grasper pulls the gallbladder by 5 to
16 mm (80 mm), a probe pushes 5 to 16 mm deep (70 mm). The map's Jacobian is positive by the bounds in
`mereo_objects._liver_parts`: in 300 random states at least 0.28; the liver had 0.89 to 1.28 of its volume at
rest, the gallbladder (thin, and where a probe pushes it) 0.56 to 1.58.

What makes it hard: smooth surfaces without landmarks, a gallbladder that is hidden from half of all directions, thin
edges, and no rigid part to hold on to.
"""

import numpy as np

from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.scene import Scene
from mereo_objects._liver_parts import PLACEMENT, SOURCE, UNIT_M, WORKSPACE, organs, sample_field


def rest_mesh() -> SegmentedMesh:
    """Liver and gallbladder at rest."""
    return SegmentedMesh(organs())


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random field of tissue, the same for both organs."""
    field = sample_field(rng)
    return (field, field)


def scene() -> Scene:
    """Scene Liver & Gallbladder; needs `liver/lapgym_liver_visual.stl` and `lapgym_gallbladder_visual.stl`."""
    T = PLACEMENT.matrix
    return Scene("liver", rest_mesh(), sample_deformations, WORKSPACE, SOURCE, unit_m=UNIT_M, T_scene_source=T)
