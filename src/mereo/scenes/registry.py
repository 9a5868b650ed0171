"""Scenes by name: the built-in ones, and those of files."""

import importlib.util
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from mereo.io.errors import AnyPath
from mereo.scenes.scene import SCENES, Scene


def is_yaml(scene: "str | Path | Scene") -> bool:
    """Whether this names a YAML scene file."""
    return isinstance(scene, AnyPath) and Path(scene).suffix.lower() in (".yaml", ".yml")


def scene_named_in(file: Path, name: str) -> Scene:
    """Scene that a data file names: a built-in one, or a YAML file where it is seen from the data file's folder.

    Raises ``ValueError`` for Python scenes, which run only where the user names them, and as ``load_scene`` does.
    """
    if name not in SCENES and not is_yaml(name):
        raise ValueError(
            f"{file} names the scene {name!r}, which is neither built in nor a YAML file; data files run no others: "
            "read the scene, and if you trust it name it yourself with --scene"
        )
    return load_scene(name if name in SCENES else file.parent / name)


def files_of(name: AnyPath) -> list[Path]:
    """Files and folders that a scene is read from, so that no output takes their place.

    Of a Python scene that is its file alone, because what it reads is not known; of a built-in one, all assets here.
    Raises as ``load_scene`` does for a faulty YAML file.
    """
    if is_yaml(name):
        return list(import_module("mereo.scenes.files.build").files_of(Path(name)))
    if name not in SCENES:
        return [Path(name)]
    from mereo_objects.assets import ASSETS, location

    return [path for path in map(location, ASSETS) if path is not None]


def load_scene(name: AnyPath) -> Scene:
    """Scene by its built-in name, or from a file, YAML or Python.

    YAML files are read by ``scenes.files.build``; Python files are run: trust them first.
    Raises ``ValueError`` listing what there is for an unknown name, or saying what is wrong with a file;
    ``FileNotFoundError`` where it, or a mesh that it names, does not exist.
    """
    if is_yaml(name):
        scene = replace(import_module("mereo.scenes.files.build").load(Path(name)), file=Path(name))
    elif Path(name).suffix == ".py":
        scene = replace(_load_python(Path(name)), file=Path(name))
    elif name in SCENES:
        scene = import_module(f"mereo_objects.{str(name).replace('-', '_')}").scene()
    else:
        raise ValueError(
            f"scene {str(name)!r} is unknown; it must be one of {', '.join(SCENES)}, or a file of your own (.yaml, as "
            "`mereo scene new` writes it, or .py with a function scene()): check the spelling"
        )
    return scene


def _load_python(path: Path) -> Scene:
    """Scene of a new name that a Python file's function ``scene`` returns; the meshes must be sound."""
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; a Python file with a function scene() is needed: check the path"
        )
    name = f"mereo_scene_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "a .py file always has a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
        scene = module.scene()
    except Exception as error:
        raise ValueError(
            f"{path} fails with {type(error).__name__}: {error}; it must run and define a function scene(): correct it "
            "(MEREO_TRACEBACK=1 shows where)"
        ) from error
    finally:
        del sys.modules[name]  # nobody else finds it by its name, and Ray sends the code of what it does not find
    if not isinstance(scene, Scene):
        raise ValueError(
            f"scene() in {path} returns a {type(scene).__name__}; it must return a Scene of mereo.scenes.scene"
        )
    if scene.name in SCENES:
        raise ValueError(f"{path} names its scene {scene.name!r}, which is a built-in scene: choose another name")
    scene.rest.check()
    return replace(scene, definition=scene.definition + path.read_text("utf-8"))
