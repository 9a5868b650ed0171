"""What is learnt: a scene, meshes for which a scene file is written, or a folder of these; and faults of it."""

import json
import shlex
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mereo.geometry.mesh_check import examine
from mereo.io.mesh_formats import MESH_SUFFIXES, read_segmented_mesh
from mereo.io.volume_files import is_volume
from mereo.io.writers.meshes import write_positions_ply
from mereo.scenes.files.build import MeshWarning
from mereo.scenes.files.check import check_scene
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

SCENE = "scene.yaml"
"""Scene file that is written for meshes."""

SEARCH = "search.json"
"""File of a folder of ``mereo learn`` with the scores of the search alone, and the scene's name or file."""

FRAME = "frame.ply"
"""File of a frame to try the object on."""

Learnable = tuple[str, list[Path]]
"""Name and files of an object."""


def list_objects(folder: Path) -> list[Learnable]:
    """Names and files of objects: each scene file (.yaml, .py) in it, each subfolder with one, or with meshes.

    Raises ``ValueError`` for a folder without objects, with two of one name, or with meshes of its own.
    """
    objects: list[Learnable] = []
    if loose := shapes_in(folder):
        raise ValueError(f"{loose[0]} lies loose in a folder of objects: put the meshes of each into a subfolder")
    for path in sorted(folder.glob("[!.]*")):
        files = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
        if content := [file for file in files if is_yaml(file) or file.suffix == ".py"] or shapes_in(path):
            objects.append((path.name if path.is_dir() else path.stem, content))
    names = [name.casefold() for name, _ in objects]  # some systems ignore case
    if not objects or len({*names}) < len(names):
        raise ValueError(
            f"{folder} has {f'two objects of one name among {names}' if objects else 'no objects'}; each is a scene "
            "file (.yaml, .py) in it, or a subfolder with a scene file, meshes, or a label volume: add or rename some"
        )
    return objects


def shapes_in(folder: Path) -> list[Path]:
    """Meshes and label volumes that lie in a folder, in the order of their names."""
    return sorted(file for file in folder.glob("[!.]*") if file.suffix.lower() in MESH_SUFFIXES or is_volume(file))


def names_scene(files: Sequence[Path]) -> bool:
    """Whether a scene is named: one that is built in, or a scene file; other files are meshes."""
    return len(files) == 1 and (str(files[0]) in SCENES or is_yaml(files[0]) or files[0].suffix == ".py")


def place_of_scene(file: Path) -> str:
    """Name of a built-in scene, or the absolute path of a file."""
    return str(file) if names_scene([file]) and not file.suffix else str(file.absolute())


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


def scene_for(files: Sequence[Path], folder: Path, units: str | None, quiet: bool = False) -> str:
    """Name or file of the scene to learn; for meshes ``folder / SCENE``, which is written where it is missing.

    Raises ``ValueError`` for no files, and for a unit of a scene, which says its own; and as ``write_scene_file`` does.
    """
    if not files:
        raise ValueError("no object is given; name a scene file, or its meshes: mereo learn base.stl arm.stl ...")
    if names_scene(files):
        if units is not None:
            raise ValueError(f"--units is {units}, but {files[0]} says its own: leave it out, or correct the file")
        return str(files[0])
    path = folder / SCENE
    if not path.is_file():
        report = None if quiet else print
        write_scene_file(files, path, units, name=files[0].name.split(".")[0], report=report)
        if not quiet:
            print(
                f"wrote {path}; where the object moves in other ways, stop with Ctrl-C, say so in that file "
                "(docs/own-object.md), and learn it anew: mereo learn FILE --output ANOTHER"
            )
    return str(path)


def scene_of_meshes(files: Sequence[Path], units: str | None = None) -> Scene:
    """Scene of meshes as ``scene_for`` writes it, without a file.

    Raises as ``write_scene_file`` does, and ``ValueError`` for a part without volume; a mesh that is no solid is used
    with a ``MeshWarning``.
    """
    new = shlex.join(map(str, files))
    cure = f"let `mereo scene new {new} --output object.yaml` and `mereo scene check object.yaml --repair` mend it"
    for file in () if is_volume(files[0]) else files:
        for part in read_segmented_mesh(file).segments:
            health = examine(part)
            if health.hopeless:
                solid = "name a file of its whole, closed surface" + (f", or {cure}" if health.mendable else "")
                fault = f"segment {part.name!r} of {file} {health.hopeless[0]}"
                raise ValueError(f"{fault}; an object's parts are solids: {solid}")
    with TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeshWarning)
        path = write_scene_file(files, Path(folder) / SCENE, units, name=files[0].name.split(".")[0])
        scene = load_scene(path)
    for warning in caught:  # which name the file that is gone
        text = str(warning.message).replace(f"{path}: ", "")
        warnings.warn(text.replace(f"repair it with `mereo scene check {path} --repair`", cure), warning.category, 2)
    return replace(scene, file=None)


def check(files: Sequence[Path], units: str | None) -> None:
    """Check an object as ``mereo scene check`` does, and print what that finds; nothing is written.

    Raises ``ValueError`` where something is wrong, with what may repair it.
    """
    with TemporaryDirectory() as folder:
        scene = scene_for(files, Path(folder), units, quiet=True)
        try:
            check_scene(scene)
        except ValueError as error:
            if not is_yaml(scene) or "listed above" not in str(error):
                raise
            raise ValueError(_refusal(files)) from None
        loaded = load_scene(scene)
    way = deformation(loaded)
    if way < 0.005:
        place = f" in {files[0]}" if names_scene(files) and is_yaml(files[0]) else ""
        print(
            f"warning: {loaded.name} hardly deforms: by {way:.2%} of its length; if it does more than that, widen its "
            f"deformations{place}"
        )


def _refusal(files: Sequence[Path]) -> str:
    """Sentence about an object with faults: which commands may mend it."""
    named = names_scene(files)
    path = files[0] if named else Path(f"{files[0].stem}.yaml")
    new = "" if named else f"`mereo scene new {shlex.join(map(str, files))} --output {path}` and "
    return (
        f"{files[0] if named else 'the object'} has faults, listed above, and nothing is learnt of a wrong object: "
        f"correct them, or let {new}`mereo scene check {path} --repair` try, and learn "
        f"{path.with_name(f'{path.stem}-repaired{path.suffix}')}"
    )


def deformation(scene: Scene) -> float:
    """Mean distance of vertices from their mean place over random states, as a share of the object's longest side."""
    states = np.stack([scene.sample_state(example_rng(0, index)).mesh.merged()[0] for index in range(24)])
    states -= states.mean(axis=1, keepdims=True)
    low, high = scene.rest.bounds
    return float(np.linalg.norm(states - states.mean(axis=0), axis=-1).mean() / (high - low).max())


def write_example_frame(scene: Scene, path: Path) -> str:
    """Write a test view as a PLY file, camera frame; returns what it is, in words with its unit.

    The cloud is in metres, the unit of a file that states none. An object whose size is not known has scene units.
    """
    view = sample_view(scene.for_seed(TEST_SEED_START), GenerateConfig(), example_rng(TEST_SEED_START, 0))
    points = view.depth.to_points().points * (scene.unit_m or 1.0)
    unit = "scene units" if scene.unit_m is None else "metres"
    write_positions_ply(path, points, comment=f"unit: {unit}")
    longest = float(np.ptp(points, axis=0).max())
    return f"a test view of {len(points)} points in {unit}; what is seen is {longest:.3g} {unit} long"
