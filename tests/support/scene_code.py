"""Text of a scene file."""

CODE = """
from mereo.deformation.maps import Identity
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.scene import Scene

def still(rng):
    return (Identity(),)

def scene():
    return Scene({name!r}, read_segmented_mesh({file!r}), still)
"""


EVERYTHING = """
deformations:
  - {type: joint, segments: [right], pivot: [120, 5, 5], axis: [0, 0, 1], angle: [-40, 40], slide: [0, 5],
     shift: [1, 2, 3]}
  - {type: lattice, strength: 0.95}
  - {type: waves, wavelength: [20, 60], strength: 0.9}
  - {type: squash, factor: [0.5, 2]}
  - {type: twist, origin: [100, 5, 5], axis: [1, 0, 0], length: 40, angle: [-90, 90]}
  - {type: taper, origin: [100, 5, 5], axis: [1, 0, 0], length: 40, factor: [0.5, 2]}
  - {type: bend, origin: [100, 5, 5], axis: [1, 0, 0], length: 40, angle: [-250, 250]}
  - {type: push, distance: [-4, 4], tip: 1, reach: 12}
"""
