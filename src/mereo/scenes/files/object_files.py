"""What files an object is of: a scene file, meshes that get one, or a folder of ``mereo learn``."""

import json
import shlex
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mereo.geometry.conventions import LengthUnit, Way
from mereo.geometry.mesh_check import examine
from mereo.io.config import RobotMeshes
from mereo.io.mesh_formats import MESH_SUFFIXES, MeshWarning
from mereo.io.readers import check_ply
from mereo.io.robots import is_robot, read_object_file
from mereo.io.volume_files import is_volume
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.scene import SCENES, Scene

SCENE = "scene.yaml"
"""Scene file that is written for meshes."""

SEARCH = "search.json"
"""File of a folder of ``mereo learn`` with the scores of the search alone, and the scene's name or file."""


def shapes_in(folder: Path) -> list[Path]:
    """Meshes and label volumes that lie in a folder, in the order of their names; clouds are neither.

    Where a robot's file is among them, the meshes are its own: that alone.
    """
    files = sorted(folder.glob("[!.]*"))
    shapes = [file for file in files if file.suffix.lower() in MESH_SUFFIXES or is_volume(file)]
    return [file for file in files if is_robot(file)] or [file for file in shapes if not _is_cloud(file)]


def _is_cloud(file: Path) -> bool:
    """Whether a file is a PLY file without faces, such as a frame; a damaged one is for its reader to refuse."""
    if file.suffix.lower() == ".ply" and file.is_file():
        with suppress(ValueError):
            return check_ply(file).get("face", 0) == 0
    return False


def names_scene(files: Sequence[Path]) -> bool:
    """Whether a scene is named: one that is built in, or a scene file; other files are meshes."""
    return len(files) == 1 and (str(files[0]) in SCENES or is_yaml(files[0]) or files[0].suffix == ".py")


def scene_of_folder(folder: Path) -> str | None:
    """Scene of a folder that ``mereo learn`` has written: its own file, or else the name or file it was learnt from.

    None where the folder is none of these. A scene in Python is not run by a folder's word: also None.
    """
    if (folder / SCENE).is_file():
        return str(folder / SCENE)
    path = folder / SEARCH
    if not path.is_file():
        return None
    with suppress(ValueError, AttributeError):
        scene = json.loads(path.read_text("utf-8")).get("scene")
        if isinstance(scene, str) and (scene in SCENES or is_yaml(Path(scene))):
            return scene
    return None


def scene_of_meshes(
    files: Sequence[Path],
    units: LengthUnit | None = None,
    deformations: Way = "auto",
    robot_meshes: RobotMeshes = "visual",
) -> Scene:
    """Scene of meshes, whose file is not kept; other arguments are as of ``MeshesConfig``.

    Raises as ``write_scene_file`` does, and ``ValueError`` for a part without volume; a mesh that is no solid is used
    with a ``MeshWarning``.
    """
    new = shlex.join(map(str, files))
    cure = f"let `mereo scene new {new} --output object.yaml` and `mereo scene check object.yaml --repair` mend it"
    with TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeshWarning)
        for file in () if is_volume(files[0]) else files:
            for part in read_object_file(file, robot_meshes).segments:
                health = examine(part)
                if refusal := health.refusal(len(part.faces)):
                    solid = "name a file of its whole, closed surface" + (f", or {cure}" if health.mendable else "")
                    fault = f"segment {part.name!r} of {file} {refusal}"
                    raise ValueError(f"{fault}; an object's parts are solids: {solid}")
        name = files[0].name.split(".")[0]
        path = write_scene_file(
            files, Path(folder) / SCENE, name=name, units=units, deformations=deformations, robot_meshes=robot_meshes
        )
        scene = load_scene(path)
    for warning in caught:  # which name the file that is gone
        text = str(warning.message).replace(f"{path}: ", "")
        warnings.warn(text.replace(f"repair it with `mereo scene check {path} --repair`", cure), warning.category, 2)
    return replace(scene, file=None)
