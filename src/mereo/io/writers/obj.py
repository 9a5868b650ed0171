"""Wavefront OBJ with its material library: text that every modelling program reads. It has no unit."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.atomic_files import atomic_file
from mereo.io.writers.glb import OUTER_OPACITY
from mereo.io.writers.segment_table import with_faces


def write_segments_obj(path: str | Path, surfaces: SegmentedMesh) -> None:
    """Write one object (``o``) per segment with a material of its colour; the materials go beside it, as ``STEM.mtl``.

    Objects and materials have the segments' names, materials with ``_`` for what is no letter or digit, because many
    programs name what they read after its material (trimesh, VTK). Positions are in the mesh's
    frame and unit. Segments without faces are left out. Raises ``ValueError`` where no segment has faces.
    """
    path = Path(path)
    library = path.with_suffix(".mtl")
    found = with_faces(surfaces)
    materials = material_names(found)
    with atomic_file(library) as partial_library, atomic_file(path) as partial:
        partial_library.write_text(_materials(found, materials, surfaces.opaque), "utf-8")
        with partial.open("w", encoding="utf-8", newline="\n") as file:
            file.write(f"# written by mereo\nmtllib {library.name}\n")
            first = 1  # OBJ counts vertices from 1, through all objects
            for (_, segment), material in zip(found, materials, strict=True):
                file.write(_object(material, segment, first))
                first += len(segment.vertices)


def material_names(found: Sequence[tuple[int, Segment]]) -> list[str]:
    """Name of each segment's material: one word, and no other's; those that would be alike get their labels."""
    words = [re.sub(r"\W+", "_", segment.name).strip("_") for _, segment in found]
    alike = Counter(words)
    return [
        word if word and alike[word] == 1 else f"{word}_label_{label}".lstrip("_")
        for (label, _), word in zip(found, words, strict=True)
    ]


def _object(material: str, segment: Segment, first: int) -> str:
    lines = [f"o {' '.join(segment.name.split())}", f"usemtl {material}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in segment.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (segment.faces + first).tolist()]
    return "\n".join(lines) + "\n"


def _materials(found: list[tuple[int, Segment]], names: list[str], opaque: tuple[bool, ...]) -> str:
    """Material library: ``Kd`` is the diffuse colour, taken as that on the screen (sRGB), ``d`` the opacity."""
    blocks = []
    for (label, segment), name in zip(found, names, strict=True):
        color = " ".join(f"{value / 255:.6f}" for value in segment.color)
        blocks.append(f"newmtl {name}\nKd {color}\nd {1.0 if opaque[label - 1] else OUTER_OPACITY}\n")
    return "\n".join(blocks)
