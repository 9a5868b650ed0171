"""Options of a command as a file, ``config.json``: what a result was made with, and what ``--config`` starts from.

    {"command": "reconstruct", "weights": "bunny", "resolution": 128, "depth_scale": 1000.0, ...}

Names are those of the options, with ``_`` for ``-``; groups such as ``--network.width`` are objects: ``{"network":
{"width": 256}}``. What the command line says wins over the file, and the file over defaults and presets. YAML is read,
too, and so is the config.json of a training, which also says what the dataset was.
"""

import json
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from tyro.conf import arg

from mereo.io.bounds import check_values

ConfigFile = Annotated[Path | None, arg(name="config")]
"""Option of commands that read their options from a file."""

NOT_RESULT = (
    "output",
    "force",
    "json",
    "resume",
    "shard",
    "workers",
    "threads",
    "ray",
    "task",
    "cpus_per_object",
    "gpus_per_object",
    "options_from",
)
"""Options of which a result is independent: a file of options does not have them, but may."""


@dataclass(frozen=True)
class GivenOptions:
    """Options that a file gives.

    Attributes:
        path: the file.
        command: whose they are.
        values: by their names, groups as mappings.
    """

    path: Path
    command: str
    values: Mapping[str, Any]

    def choice(self, name: str) -> str | None:
        """Value of an option that is a word, where the file has it."""
        value = self.values.get(name)
        return value if isinstance(value, str) else None


def read_options(path: Path, command: str) -> GivenOptions:
    """Options of a file for a command.

    Raises ``FileNotFoundError``, and ``ValueError`` for what is no mapping of names and for another command's options.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; --config takes a file of options, such as a result's config.json"
        )
    values = _parsed(path)
    if values.keys() == {"dataset", "train"} and isinstance(values["train"], dict):  # as a run has it
        values = {"command": "train", **values["train"]}
    of = values.pop("command", command)
    if of != command:
        raise ValueError(f"{path} has options of `mereo {of}`, not of `mereo {command}`: use them with that command")
    return GivenOptions(path, command, _plain_names(values))


def _parsed(path: Path) -> dict[str, Any]:
    import yaml

    try:
        text = path.read_text("utf-8")
        values = yaml.safe_load(text) if path.suffix.lower() in (".yaml", ".yml") else json.loads(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no file of options ({' '.join(str(error).split())}): correct it") from None
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path} is no file of options; it must name each with its value: see docs/quickstart.md")
    return values


def _plain_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same with ``_`` in names, where command lines have ``-``."""
    return {
        str(name).removeprefix("--").replace("-", "_"): _plain_names(value) if isinstance(value, dict) else value
        for name, value in values.items()
    }


# --- from a file to a command's defaults ------------------------------------------------------------------------------


def defaults_from(command: type, given: GivenOptions, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Defaults of a command's fields that the options of a file decide, beside other ``defaults``.

    Raises ``ValueError`` for an option that the command does not have, and for values that it cannot have.
    """
    left = dict(given.values)
    found = _filled(command, left, dict(defaults), given.path, "")
    if left:
        _refuse(given.path, next(iter(left)), command, "")
    check_values(command, found, "--")  # here, where defaults, which are given for an example, are still the command's
    return {**defaults, **found}


def _filled(settings: type, given: dict[str, Any], base: Mapping[str, Any], path: Path, prefix: str) -> dict[str, Any]:
    """Values of the fields of a dataclass that ``given`` decides; what is taken is removed from it."""
    kinds, found = get_type_hints(settings, include_extras=True), dict[str, Any]()
    for item in fields(settings):
        name, inner = option_name(item, kinds[item.name]), _dataclass_of(kinds[item.name])
        if inner is None:
            if item.name != "options_from" and name in given and not isinstance(given[name], dict):
                found[item.name] = _converted(kinds[item.name], given.pop(name), path, prefix + name)
            continue
        start = base[item.name] if item.name in base else _default(item)
        part = given if not name else given.pop(name) if isinstance(given.get(name), dict) else {}
        changed = _filled(inner, part, vars(start), path, f"{prefix}{name}." if name else prefix)
        if name and part:
            _refuse(path, f"{prefix}{name}.{next(iter(part))}", inner, f"{prefix}{name}.")
        if changed:
            found[item.name] = replace(start, **changed)
    return found


def option_name(item: "Field[Any]", kind: Any) -> str:
    """Name of a field's option, with ``_``; empty where its own fields stand beside the others."""
    names = [getattr(extra, "name", None) for extra in getattr(kind, "__metadata__", ())]
    return next((name.replace("-", "_") for name in names if isinstance(name, str)), item.name)


def _dataclass_of(kind: Any) -> type | None:
    plain = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    return plain if isinstance(plain, type) and is_dataclass(plain) else None


def _default(item: "Field[Any]") -> Any:
    return item.default if item.default_factory is MISSING else item.default_factory()


def _converted(kind: Any, value: Any, path: Path, name: str) -> Any:
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        said = error.errors()[0]["msg"]
        raise ValueError(f"{path} has {name} = {value!r}, which cannot be ({said}): correct it") from None


def _refuse(path: Path, name: str, settings: type, prefix: str) -> None:
    near = get_close_matches(name, [prefix + option for option in _names(settings)], 1)
    cure = f"correct it, perhaps to {near[0]!r}" if near else "take it out"
    raise ValueError(f"{path} has {name!r}, which is no option of this command: {cure} (--help names all)")


def _names(settings: type) -> list[str]:
    kinds, found = get_type_hints(settings, include_extras=True), []
    for item in fields(settings):
        name, inner = option_name(item, kinds[item.name]), _dataclass_of(kinds[item.name])
        found += _names(inner) if inner is not None and not name else [name]
    return sorted(set(found) - {"config"})


# --- from a command to its file ---------------------------------------------------------------------------------------


def options_of(command: Any, name: str) -> dict[str, Any]:
    """Content of the file of options of a command that runs: all that decides its result, files by absolute paths."""
    return {"command": name, **_stated(command, NOT_RESULT)}


def _stated(settings: Any, without: tuple[str, ...] = ()) -> dict[str, Any]:
    kinds, stated = get_type_hints(type(settings), include_extras=True), dict[str, Any]()
    for item in fields(settings):
        name, value = option_name(item, kinds[item.name]), getattr(settings, item.name)
        if item.name in without:
            continue
        if is_dataclass(value):
            stated |= {name: _stated(value)} if name else _stated(value)
        else:
            stated[name] = _absolute(value)
    return stated


def _absolute(value: Any) -> Any:
    """Value with files that are there by their absolute paths, wherever the options are read again."""
    if isinstance(value, tuple):
        return [_absolute(each) for each in value]
    if isinstance(value, Path):
        return str(value.absolute())
    if isinstance(value, str) and Path(value).suffix and Path(value).is_file():
        return str(Path(value).absolute())
    return value
