"""Write the meshes and the scene file of a desk lamp, as an object of your own that has joints.

    python examples/desk_lamp.py
    mereo learn lamp/lamp.yaml --output learned

The lamp stands on the origin, z up, in millimetres: base, two arms and a shade, each a closed mesh in its own file.
"""

from pathlib import Path

import numpy as np
import trimesh

from mereo.scenes.files.template import write_scene_file

FOLDER = Path("lamp")

SHOULDER, ELBOW, NECK = (0.0, 0.0, 36.0), (0.0, 0.0, 216.0), (150.0, 0.0, 262.0)
"""Where the lower arm stands on the base, the upper arm on the lower one, and the shade on the upper one."""

BESIDE = (0.0, 26.0, 0.0)
"""The upper arm is bolted to the side of the lower one, so that they pass each other."""

JOINTS = f"""\
deformations:  # the joint at the tip comes first
  - {{type: joint, segments: [shade], pivot: {[*NECK]}, axis: [0, 1, 0], angle: [-35, 35]}}
  - {{type: joint, segments: [upper_arm, shade], pivot: {[*ELBOW]}, axis: [0, 1, 0], angle: [-40, 40]}}
  - {{type: joint, segments: [lower_arm, upper_arm, shade], pivot: {[*SHOULDER]}, axis: [0, 1, 0], angle: [-30, 30]}}
  - {{type: joint, segments: [lower_arm, upper_arm, shade], pivot: {[*SHOULDER]}, axis: [0, 0, 1], angle: [-60, 60]}}
"""


def parts() -> dict[str, trimesh.Trimesh]:
    """Closed meshes of the lamp at rest."""
    shade = trimesh.creation.revolve([(0, -5), (20, -5), (55, -80), (60, -80), (24, 0), (0, 0)], sections=40)
    shade.apply_translation(np.add(NECK, (0, -20, -24)))
    return {
        "base": trimesh.creation.cylinder(75.0, segment=[(0, 0, 0), (0, 0, 20)], sections=48),
        "lower_arm": arm(SHOULDER, ELBOW),
        "upper_arm": arm(np.add(ELBOW, BESIDE), np.add(NECK, BESIDE)),
        "shade": shade,
    }


def arm(start: tuple[float, ...] | np.ndarray, end: tuple[float, ...] | np.ndarray) -> trimesh.Trimesh:
    """Round bar between two places, with half a ball at each end."""
    along = np.subtract(end, start)
    bar = trimesh.creation.capsule(float(np.linalg.norm(along)), 12.0, count=[12, 12])
    bar.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], along))
    bar.apply_translation(np.add(start, end) / 2)
    return bar


def main(folder: Path = FOLDER) -> Path:
    """Write the lamp into a folder; returns the scene file."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, mesh in parts().items():
        files.append(folder / f"{name}.stl")
        mesh.export(files[-1])
    path = write_scene_file(files, folder / "lamp.yaml", units="mm", aperture=140.0)  # a lamp stands
    text = path.read_text("utf-8")  # a new file bends as rubber does; a lamp has joints instead
    path.write_text(text[: text.index("deformations:")] + JOINTS, "utf-8")
    print(f"wrote {path}; then: mereo learn {path} --output learned")
    return path


if __name__ == "__main__":
    main()
