"""Scenes of your own, as Python files with a function ``scene() -> Scene``. The file is run: trust it first."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

from mereo.scenes.scene import SCENES, Scene


def load(path: Path) -> Scene:
    """Scene that a Python file's function ``scene`` returns; the meshes must be sound.

    Raises ``FileNotFoundError``, and ``ValueError`` where the file fails or returns no sound scene of a new name.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; a Python file with a function scene() is needed: check the path"
        )
    scene = _run(path)
    if not isinstance(scene, Scene):
        raise ValueError(
            f"scene() in {path} returns a {type(scene).__name__}; it must return a Scene of mereo.scenes.scene"
        )
    if scene.name in SCENES:
        raise ValueError(f"{path} names its scene {scene.name!r}, which is a built-in scene: choose another name")
    scene.rest.check()
    return replace(scene, definition=scene.definition + path.read_text("utf-8"))


def _run(path: Path) -> object:
    name = f"mereo_scene_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "a .py file always has a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
        return module.scene()
    except Exception as error:
        raise ValueError(
            f"{path} fails with {type(error).__name__}: {error}; it must run and define a function scene(): correct it "
            "(MEREO_TRACEBACK=1 shows where)"
        ) from error
    finally:
        del sys.modules[name]  # nobody else finds it by its name, and Ray sends the code of what it does not find
