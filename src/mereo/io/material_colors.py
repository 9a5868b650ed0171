"""Colours of the materials that an OBJ file names: its material library (MTL), a text file beside it.

A library is no part of the shape: where it is missing or damaged, there are no colours, and no error.
"""

from pathlib import Path

from mereo.geometry.mesh import Color


def material_colors(mesh: Path, library: str) -> dict[str, Color]:
    """Diffuse colour (``Kd``, taken as that on the screen) of each material without a texture.

    Args:
        mesh: the OBJ file.
        library: what it calls its library; "" for none. Only a file in the same folder is read, because a mesh that
            comes from elsewhere should not choose which files are opened.
    """
    path = mesh.parent / library
    if not library or Path(library).name != library or not path.is_file():
        return {}
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except (OSError, MemoryError):
        return {}
    colors: dict[str, Color] = {}
    textured: set[str] = set()
    name = ""
    for line in lines:
        kind, *cells = line.split() or [""]
        if kind == "newmtl":
            name = " ".join(cells)
        elif kind == "Kd" and (color := _color(cells)) is not None:
            colors[name] = color
        elif kind == "map_Kd":
            textured.add(name)
    return {name: color for name, color in colors.items() if name not in textured}


def _color(cells: list[str]) -> Color | None:
    """Colour of three numbers from 0 to 1; None for anything else (a spectral curve, CIE XYZ, damage)."""
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        return None
    if len(values) != 3 or not all(0 <= value <= 1 for value in values):
        return None
    red, green, blue = (round(255 * value) for value in values)
    return red, green, blue
