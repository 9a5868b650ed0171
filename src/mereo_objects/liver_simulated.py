"""Liver & Gallbladder in states of a finite-element simulation: the object of the scene `liver`, moved by physics.

Source: the organs as in the scene `liver` (LapGym, MIT, (c) 2023 Paul Scheikl). The states come with the package,
`mereo/states/liver.npz`, made by `examples/simulate_liver.py --organs --frames 300` with MuJoCo.

Segments: `liver` and `gallbladder`, the same as in `liver`: weights trained on one scene can be tested on the other.
Both lie in one lattice of 3,600 tetrahedra (16 mm edges, 1,098 nodes), so one piecewise affine map moves them and they
stay in contact. The lattice is a mesh of the simulation, not of the organs: its outer cells are partly empty, which
makes thin edges stiffer than they are.

Degrees of freedom: 300 states, the last 30 of which only test seeds see. Each is the equilibrium of soft tissue
(Young's modulus 5 kPa, Poisson's ratio 0.4) held at its back, under one to three instruments that take hold at random
and move the tissue by 10 to 35 mm in any direction, and up to a tenth of gravity to any side. Tissue moves by up to
40 mm; every tetrahedron keeps between 0.35 and 1.46 of its volume, each organ between 0.90 and 1.02.

What makes it hard: as in `liver`, and the states are finitely many. A network may learn them by heart; the scores on
test seeds, which are states never seen, show it.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import mereo
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.recorded_states import load_states
from mereo.scenes.scene import Scene
from mereo_objects._liver_parts import MM, PLACEMENT, SOURCE, UNIT_M, WORKSPACE, organs

STATES = Path(mereo.__file__).parent / "states" / "liver.npz"


@cache
def scene() -> Scene:
    """Scene of the simulated liver; needs the same assets as the scene `liver`."""
    rest = SegmentedMesh(organs())
    states = load_states(STATES, rest, scale=MM)
    liver = states.scene("liver-simulated", rest, WORKSPACE, f"{SOURCE}; states simulated with MuJoCo")
    return replace(liver, unit_m=UNIT_M, T_scene_source=PLACEMENT.matrix)
