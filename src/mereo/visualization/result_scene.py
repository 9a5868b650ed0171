"""Scene file of a result: what its summary says of it, and the scene again while the file is as it was.

Scene -scene_facts-> summary.json -scene_of_result-> Scene

A registration of a scene's own draws means something only with that scene. Files of results run no code, so a scene
that is a Python file is named, but never opened for them.
"""

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from mereo.io.writers.formats import WRITERS
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.rest_pose import rest_digest
from mereo.scenes.scene import Scene

MOST_BYTES = 2**24
"""Size above which a file is no summary: one of ten segments takes 4 kB."""


class SceneFile(BaseModel, frozen=True):
    """Scene file as a summary names it.

    Attributes:
        path: as it was given, from the folder where the command ran.
        sha256: of what it states, and of the segments at rest.
    """

    path: Annotated[str, Field(min_length=1, max_length=4096)]
    sha256: str


class _Summary(BaseModel):
    scene_file: SceneFile


def scene_facts(scene: Scene | None) -> dict[str, object]:
    """What a summary says of the scene that was given; nothing of one that is no file's."""
    if scene is None or scene.file is None:
        return {}
    return _Summary(scene_file=SceneFile(path=str(scene.file), sha256=_digest(scene))).model_dump()


def scene_of_result(path: Path) -> Scene | None:
    """Scene that a result (its folder, or the state in it) was made with; None where its summary names no file.

    Raises ``FileNotFoundError`` where the file is gone, and ``ValueError`` where it is another one now, is run as
    Python, or is damaged.
    """
    told = _told(path / WRITERS["json"].file if path.is_dir() else path.with_name(WRITERS["json"].file))
    if told is None:
        return None
    made = f"{path} was made with the scene file {told.path}"
    if not is_yaml(told.path):
        raise ValueError(
            f"{made}, and files of results run no Python: read it, and if you trust it name it yourself with --scene, "
            "which opens the laboratory in this state"
        )
    if not Path(told.path).is_file():
        raise FileNotFoundError(
            f"{made}, which is not there as seen from here: run this in the folder from which that path leads to it, "
            "or name it with --scene, which opens the laboratory in this state"
        )
    scene = load_scene(told.path)
    if _digest(scene) != told.sha256:
        raise ValueError(f"{made}; that or its meshes have changed since: bring them back, or register the frame again")
    return scene


def _told(summary: Path) -> SceneFile | None:
    """What a summary says; None where there is none, or none that says it."""
    if not summary.is_file() or summary.stat().st_size > MOST_BYTES:
        return None
    try:
        return _Summary.model_validate_json(summary.read_bytes()).scene_file
    except ValidationError:
        return None


def _digest(scene: Scene) -> str:
    return hashlib.sha256((rest_digest(scene.rest) + scene.definition).encode()).hexdigest()
