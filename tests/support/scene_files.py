"""Scene files in a temporary folder, for the tests: a bar of two boxes that touch, and what a test adds to it."""

from pathlib import Path

import trimesh
from shapes import box

from mereo.geometry.mesh import Segment

HEAD = """\
name: bar
units: mm
segments:
  - name: left
    file: left.stl
  - name: right
    file: right.stl
    color: [1, 2, 3]
"""


def write_mesh(segment: Segment, path: Path) -> Path:
    trimesh.Trimesh(segment.vertices, segment.faces, process=False).export(path)
    return path


def write_bar(folder: Path, tail: str = "", head: str = HEAD) -> Path:
    """Boxes from x = 100 to 120 and on to 140, 10 mm thick, on the plane x = 120 in contact; refined so as to bend."""
    for name, low in (("left", 100), ("right", 120)):
        part = box((low, 0, 0), (low + 20, 10, 10), name)
        mesh = trimesh.Trimesh(part.vertices, part.faces).subdivide().subdivide()
        mesh.export(folder / f"{name}.stl")
    path = folder / "bar.yaml"
    path.write_text(head + tail, encoding="utf-8")
    return path
