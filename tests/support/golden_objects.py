"""Two objects as users own them, whose small weights lie in ``golden/``: a soft lump, and pliers with a hinge.

    python tests/support/golden_objects.py FOLDER [OBJECT ...]

writes the scenes into a folder and trains their weights anew, in five minutes each.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
from cad_objects import write_pliers
from trimesh.creation import icosphere

FOLDER = Path(__file__).parents[1] / "golden"

LUMP = """\
name: lump
units: mm
segments:
  - name: core
    file: core.stl
    nested_in: lobe
  - name: lobe
    file: lobe.stl
  - name: tip
    file: tip.stl
deformations:
  - type: bend
    origin: [-60, 0, 0]
    axis: [1, 0, 0]
    length: 150
    angle: [0, 50]
  - type: lattice
    cells: [3, 2, 2]
    strength: 0.4
"""

PLIERS = """\
name: pliers
units: mm
segments:
  - name: upper
    file: upper.stl
  - name: lower
    file: lower.stl
  - name: pin
    file: pin.stl
size: 5.83
camera:
  axis: [0, 0, 1]
  distance: [139, 174]
  field_of_view: 41
deformations:
  - type: joint
    segments: [upper]
    pivot: [0, 0, 0]
    axis: [0, 0, 1]
    angle: [0, 35]
"""


def write_lump(folder: Path) -> Path:
    """Write the soft object: a lobe with a core inside and a tip that lies on it, 120 mm long."""
    folder.mkdir(parents=True, exist_ok=True)
    lobe = icosphere(subdivisions=3)
    x, y, z = lobe.vertices.T
    lobe.vertices = np.stack([60 * x, (30 + 8 * x) * y, (22 - 6 * x) * z + 6 * x**2], axis=1)
    core = icosphere(subdivisions=2, radius=11)
    core.apply_translation((-18, 2, 0))
    tip = icosphere(subdivisions=2)
    tip.vertices = tip.vertices * (14, 16, 10) + (76, 0, 6)
    for name, mesh in (("lobe", lobe), ("core", core), ("tip", tip)):
        mesh.export(folder / f"{name}.stl")
    path = folder / "lump.yaml"
    path.write_text(LUMP, encoding="utf-8")
    return path


def write_jointed(folder: Path) -> Path:
    """Write the object of rigid parts: pliers, whose upper lever turns about the pin."""
    folder.mkdir(parents=True, exist_ok=True)
    write_pliers(folder)
    path = folder / "pliers.yaml"
    path.write_text(PLIERS, encoding="utf-8")
    return path


OWN = {"lump": write_lump, "pliers": write_jointed}
"""What writes each object's scene into a folder."""


def weights_of(name: str) -> Path:
    """File of an object's weights."""
    return FOLDER / f"{name}.safetensors"


def train(name: str, folder: Path) -> None:
    """Train an object's weights, from examples of seed 1, and put them beside the answers in half precision."""
    from torch import float16

    from mereo.models.weights import load_model, save_model

    scene = OWN[name](folder / name)
    data = folder / f"{name}-data"
    run = folder / f"{name}-run"
    small = run / "small.safetensors"

    def mereo(*command: object) -> None:
        print(*command, flush=True)
        subprocess.run([sys.executable, "-m", "mereo", *map(str, command)], check=True)

    mereo("generate", scene, "--output", data, "--examples", 600, "--seed", 1, "--workers", 2)
    mereo("train", data, "--output", run, "--preset", "tiny", "--epochs", 60, "--holdout", 40)
    save_model(load_model(run / "weights.safetensors"), small, float16)
    mereo("calibrate", small, "--scene", scene, "--views", 16, "--output", weights_of(name))


if __name__ == "__main__":
    for each in sys.argv[2:] or OWN:
        train(each, Path(sys.argv[1]))
