"""Options of a command as a file, ``config.json``: what a result was made with, and what ``--config`` starts from.

    {"command": "reconstruct", "weights": "bunny", "resolution": 128, "depth_scale": 1000.0, ...}

Names are those of the options, with ``_`` for ``-``; groups such as ``--network.width`` are objects: ``{"network":
{"width": 256}}``. What the command line says wins over the file, and the file over defaults and presets. YAML is read,
too, and so is the config.json of a training, which also says what the dataset was.
"""

import json
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from tyro.conf import arg

from mereo.io.bounds import check_values

ConfigFile = Annotated[Path | None, arg(name="config")]
"""Option of commands that read their options from a file."""

NOT_RESULT = (
    *("output", "force", "json", "resume", "shard", "workers", "threads", "ray", "task"),
    *("cpus_per_object", "gpus_per_object"),
)
"""Fields of which a result is independent: a command does not write them into its file, but reads them from one."""


def read_options(path: Path, command: str) -> dict[str, Any]:
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
    of = values.pop("command", command)
    if of != command:
        raise ValueError(f"{path} has options of `mereo {of}`, not of `mereo {command}`: use them with that command")
    return dict(flat_options(values))


def flat_options(values: dict[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each option of nested groups with its value, its name like ``network.width``."""
    for key, value in values.items():
        name = prefix + str(key).removeprefix("--").replace("-", "_")
        if isinstance(value, dict):
            yield from flat_options(value, f"{name}.")
        else:
            yield name, value


def with_options(command: Any, options: dict[str, Any], path: Path) -> Any:
    """Copy of a command with the options of a file; ``ValueError`` for a wrong name or value names the file."""
    known = list[str]()
    try:
        changed = _replaced(command, options, "", known)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for name in options.keys() - known:
        near = get_close_matches(name, known, 1)
        cure = f"correct it, perhaps to {near[0]!r}" if near else "take it out"
        raise ValueError(f"{path} has {name!r}, which is no option of this command: {cure} (--help names all)")
    return changed


def _replaced(settings: Any, options: dict[str, Any], prefix: str, known: list[str]) -> Any:
    from pydantic import TypeAdapter, ValidationError

    changes = dict[str, Any]()
    for field, name, kind, value in _items(settings, prefix):
        if is_dataclass(value):
            changes[field] = _replaced(value, options, name, known)
            continue
        known.append(name)
        if name in options:
            try:
                changes[field] = TypeAdapter(kind).validate_python(options[name])
            except ValidationError as error:
                raise ValueError(
                    f"{name} is {options[name]!r}, which cannot be ({error.errors()[0]['msg']}): correct it"
                ) from None
    check_values(type(settings), changes)
    return replace(settings, **changes)


def _items(settings: Any, prefix: str) -> Iterator[tuple[str, str, Any, Any]]:
    """Field, name of its option, kind and value; the name of a group ends with a dot, or is the prefix alone."""
    kinds = get_type_hints(type(settings), include_extras=True)
    for field, kind in ((item.name, kinds[item.name]) for item in fields(settings)):
        value, names = (
            getattr(settings, field),
            [getattr(extra, "name", None) for extra in getattr(kind, "__metadata__", ())],
        )
        name = next((each for each in names if isinstance(each, str)), field)
        if field != "options_from":
            yield field, prefix + name + "." * (is_dataclass(value) and name != ""), kind, value


def options_of(command: Any, name: str) -> dict[str, Any]:
    """Content of the file of options of a command that runs: all that decides its result, files by absolute paths."""
    return {"command": name, **_stated(command)}


def _stated(settings: Any) -> dict[str, Any]:
    stated = dict[str, Any]()
    for field, name, _, value in _items(settings, ""):
        if field in NOT_RESULT:
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
