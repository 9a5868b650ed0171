"""What options of several commands share: their kinds, the object that they name, and what a command leaves behind.

Positional arguments have one word for one thing in all commands, as usage lines and help show it:

SCENE    a name from `mereo scene list`, or a scene file
OBJECT   what an object is made from: its meshes, or a label volume
DATASET  folder of `mereo generate`, or its URL
WEIGHTS  a shipped name, or a file
INPUT    what a sensor has seen: depth image, cloud, recording, or a folder of such
SCAN     a cloud that truth is made for
ASSET    a name from `mereo assets list`
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

from mereo.geometry.conventions import Facts, Names
from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import GROUP, check_values
from mereo.io.config import InputConfig, MeshesConfig
from mereo.io.errors import AnyPath, nearest
from mereo.io.object_storage import Place, place_of
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig

if TYPE_CHECKING:
    from mereo.api.objects import Object


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command that answers.

    Attributes:
        facts: content of the JSON object that ``--json`` prints.
        status: exit status.
    """

    facts: Facts
    status: int = 0


# --- kinds of options -------------------------------------------------------------------------------------------------


class _InOptionsFile:
    """How pydantic reads what a file of options has for a ``PlaceOption``."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(place_of, core_schema.str_schema())


PlaceOption = Annotated[
    Place,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: place_of(words[0]),
        is_instance=lambda value: isinstance(value, Place),
        str_from_instance=lambda place: [str(place)],
    ),
    _InOptionsFile(),
]
"""Local path or URL of an object storage, of which ``Path`` would make s3:/bucket."""

Paths = tuple[Path, ...]
SceneName = Annotated[Positional[str], arg(metavar="SCENE")]
ObjectFiles = Annotated[Positional[Paths], arg(metavar="OBJECT [OBJECT ...]", help_behavior_hint="(required)")]
DatasetFolder = Annotated[Positional[PlaceOption], arg(metavar="DATASET")]
WeightsName = Annotated[Positional[str], arg(metavar="WEIGHTS")]
WeightsFiles = Annotated[Positional[Paths], arg(metavar="[WEIGHTS ...]", help_behavior_hint="")]
Inputs = Annotated[Positional[Paths], arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(required)")]
InputOrNone = Annotated[Positional[Path | None], arg(metavar="[INPUT]", help_behavior_hint="")]
InputName = Annotated[Positional[str], arg(metavar="INPUT")]
ScanCloud = Annotated[Positional[Path], arg(metavar="SCAN")]
AssetNames = Annotated[Positional[Names], arg(metavar="[ASSET ...]", help_behavior_hint="")]

ConfigFile = Annotated[Path | None, arg(name="config")]
"""Option of commands that read their options from a file."""


# --- the object that options name -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Options of the commands that look for an object in frames.

    Attributes:
        object: what is looked for, as for `mereo reconstruct`: its meshes or its scene.
        weights: a shipped name or a file; with --object they start the fit, without they say what is looked for.
        meshes: what files of meshes do not say.
        joints: file of joints whose values are known, as for `mereo reconstruct`.
        reading: how a frame is read.
        isolation: what of a frame is left out.
        inference: where and how exactly the network computes.
    """

    object: Names = ()
    weights: str | None = None
    meshes: Annotated[MeshesConfig, GROUP] = field(default_factory=MeshesConfig)
    joints: Path | None = None
    reading: Annotated[InputConfig, GROUP] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, GROUP] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, GROUP] = field(default_factory=InferenceConfig)


def check_named(command: str, object: Sequence[str], weights: AnyPath | None) -> None:
    """Raise ``ValueError`` where neither an object nor weights are named."""
    if not object and weights is None:
        raise ValueError(
            f"no object is named; name its meshes or its scene with --object, or its weights with --weights: mereo "
            f"{command} FRAME --object PART.stl PART.stl"
        )


def loaded_object(command: FrameOptions, inference: InferenceConfig | None = None) -> "Object":
    """Object that a command's options name, with the joints that are known; raises as ``load_object`` does.

    One word of ``--object`` that is a built-in scene's name is that scene; its weights are named by ``--weights``.
    ``inference`` is where the network computes, where that is not as the options say.
    """
    from mereo.api.objects import object_of
    from mereo.scenes.registry import load_scene
    from mereo.scenes.scene import SCENES

    object = command.object
    scene = getattr(command, "scene", None)
    inference = inference or command.inference
    if object and scene is not None:
        raise ValueError(f"--scene is {scene}, but --object says what the object is: leave one of them out")
    source = (object[0] if len(object) == 1 else list(object)) or None
    return object_of(
        load_scene(source) if source in SCENES else source,
        command.joints,
        scene=scene,
        weights=command.weights,
        **vars(command.meshes),
        **vars(inference),
    )


def files_read(object: Sequence[str], weights: AnyPath | None) -> list[AnyPath]:
    """Files that are read for these options, so that no output takes their place."""
    return [*(name for name in object if Path(name).exists()), *([] if weights is None else [weights])]


# --- a file of options ------------------------------------------------------------------------------------------------

# Options of a command as a file, ``config.json``: what a result was made with, and what ``--config`` starts from.
#
#     {"command": "reconstruct", "weights": "bunny", "resolution": 128, "depth_scale": 1000.0, ...}
#
# Names are those of the options, with ``_`` for ``-``; groups such as ``--network.width`` are objects: ``{"network":
# {"width": 256}}``. What the command line says wins over the file, and the file over defaults and presets. YAML is
# read, too, and so is the config.json of a training, which also says what the dataset was.

NOT_RESULT = (
    *("output", "force", "json", "resume", "shard", "workers", "threads", "ray", "task"),
    *("cpus_per_object", "gpus_per_object"),
)
"""Fields of which a result is independent: a command does not write them into its file, but reads them from one."""


def read_options(path: Path, command: str) -> JsonObject:
    """Options of a file for a command, by name, those of groups as ``network.width``.

    Raises ``FileNotFoundError``, and ``ValueError`` for what is no mapping of names and for another command's options.
    """
    import yaml

    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; --config takes a file of options, such as a result's config.json"
        )
    try:
        text = path.read_text("utf-8")
        values = yaml.safe_load(text) if path.suffix.lower() in (".yaml", ".yml") else json.loads(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no file of options ({' '.join(str(error).split())}): correct it") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} is no file of options; it must name each with its value: see docs/quickstart.md")
    if values.keys() == {"dataset", "train"} and isinstance(values["train"], dict):  # as a run has it
        values = {"command": "train", **values["train"]}
    other = values.pop("command", command)
    if other != command:
        raise ValueError(f"{path} has options of `mereo {other}`, not of `mereo {command}`: use them with that command")
    return dict(flat_options(values))


def flat_options(values: dict[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each option of nested groups with its value, its name like ``network.width``."""
    for key, value in values.items():
        name = prefix + str(key).removeprefix("--").replace("-", "_")
        if isinstance(value, dict):
            yield from flat_options(value, f"{name}.")
        else:
            yield name, value


def with_options(command: Any, options: JsonObject, path: Path) -> Any:
    """Copy of a command with the options of a file; ``ValueError`` for a wrong name or value names the file."""
    known = list[str]()
    try:
        changed = _replaced(command, options, "", known)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for name in options.keys() - known:
        near = nearest(name, known)
        cure = f"correct it, perhaps to {near!r}" if near else "take it out"
        raise ValueError(f"{path} has {name!r}, which is no option of this command: {cure} (--help names all)")
    return changed


def _replaced(settings: Any, options: JsonObject, prefix: str, known: list[str]) -> Any:
    from pydantic import TypeAdapter, ValidationError

    changes = JsonObject()
    for attribute, name, kind, value in _items(settings, prefix):
        if is_dataclass(value):
            changes[attribute] = _replaced(value, options, name, known)
            continue
        known.append(name)
        if name in options:
            try:
                changes[attribute] = TypeAdapter(kind).validate_python(options[name])
            except ValidationError as error:
                raise ValueError(
                    f"{name} is {options[name]!r}, which cannot be ({error.errors()[0]['msg']}): correct it"
                ) from None
    check_values(type(settings), changes)
    return replace(settings, **changes)


def _items(settings: Any, prefix: str) -> Iterator[tuple[str, str, Any, Any]]:
    """Field, name of its option, kind and value; the name of a group ends with a dot, or is the prefix alone."""
    kinds = get_type_hints(type(settings), include_extras=True)
    for attribute in (item.name for item in fields(settings) if item.name != "options_from"):
        kind = kinds[attribute]
        value = getattr(settings, attribute)
        names = [getattr(extra, "name", None) for extra in getattr(kind, "__metadata__", ())]
        name = next((each for each in names if isinstance(each, str)), attribute)
        yield attribute, prefix + name + "." * (is_dataclass(value) and name != ""), kind, value


def options_of(command: Any, name: str) -> JsonObject:
    """Content of the file of options of a command that runs: all that decides its result, files by absolute paths."""
    return {"command": name, **_stated(command)}


def _stated(settings: Any) -> JsonObject:
    stated = JsonObject()
    for attribute, name, _, value in _items(settings, ""):
        if attribute in NOT_RESULT:
            continue
        if is_dataclass(value):
            stated |= {name.rstrip("."): _stated(value)} if name else _stated(value)
        else:
            stated[name] = _absolute(value)
    return stated


def _absolute(value: Any) -> Any:
    """Value with files that are there by their absolute paths, wherever the options are read again."""
    if isinstance(value, tuple):
        return [_absolute(each) for each in value]
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).suffix and Path(value).is_file()):
        return str(Path(value).absolute())
    return value
