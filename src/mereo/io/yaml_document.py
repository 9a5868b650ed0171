"""A YAML file with its line numbers: what is wrong in it is said as file, line, value, rule and cure."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from mereo.io.errors import nearest, reason

Model = TypeVar("Model", bound=BaseModel)

Place = Sequence[int | str]
"""Keys and indices from the top of the document, for example ("deformations", 0, "angle")."""

MOST_BYTES = 500_000
"""Size of a file, which is parsed in some ten seconds."""

MOST_VALUES = 100_000
"""Values of a document, those of aliases counted where they stand: a few lines of nested aliases are billions."""


class Document:
    """YAML mapping with the lines of its values: the file's ``path`` and ``text``, and ``data``, Python's values."""

    def __init__(self, path: Path, kind: str = "scene file", start: str = "name:") -> None:
        """Read a file of a kind, which starts with a key; a line of dashes at its end, as ROS prints, is left out.

        Raises ``FileNotFoundError``, or ``ValueError`` where it is no YAML mapping.
        """
        self.path = path
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist; a {kind} is needed: check the path")
        if (size := path.stat().st_size) > MOST_BYTES:
            raise ValueError(f"{path} has {size:,} bytes; a {kind} has at most {MOST_BYTES:,}: is it the right one?")
        try:
            self.text = path.read_text(encoding="utf-8").rstrip().removesuffix("\n---")
            # two passes, because only nodes know their lines and only values their types
            root = yaml.compose(self.text, Loader=yaml.SafeLoader)
            count = _count(root, {})
            self.data: Any = yaml.safe_load(self.text) if count <= MOST_VALUES else None
        except RecursionError:  # also of what contains itself by an alias
            raise ValueError(f"{path} is nested too deeply; a {kind} has lists in blocks: write it again") from None
        except (yaml.YAMLError, ValueError, KeyError) as error:  # the last two of dates, numbers and truth values
            mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
            place = f"{path}:{mark.line + 1}" if mark else path
            why = getattr(error, "problem", None) or reason(error)
            raise ValueError(f"{place}: this is not YAML in UTF-8 ({why}): correct it, or put it in quotes") from None
        if count > MOST_VALUES:
            raise ValueError(f"{path} holds {count} values; at most {MOST_VALUES} can be read: use fewer aliases")
        if not isinstance(root, yaml.MappingNode):
            raise ValueError(f"{path} holds no `key: value` lines; a {kind} starts with `{start}`: write one")
        self._root: yaml.Node = root
        self._refuse_repeated(root)

    def _refuse_repeated(self, node: yaml.Node) -> None:
        """Refuse keys that stand twice: YAML takes the last of two in silence."""
        if isinstance(node, yaml.SequenceNode):
            for item in node.value:
                self._refuse_repeated(item)
        elif isinstance(node, yaml.MappingNode):
            seen = set[str]()
            for key, value in node.value:
                if key.value in seen:
                    line = key.start_mark.line + 1
                    raise ValueError(f"{self.path}:{line}: the key `{key.value}` is given twice: remove one of them")
                seen.add(key.value)
                self._refuse_repeated(value)

    def pair(self, place: Place) -> tuple[yaml.Node, yaml.Node]:
        """Node of the key and of the value at a place, or of the innermost block around it that is there.

        For the items of a list both are the item. A name that no key has, such as a tag of pydantic, is passed over.
        """
        key = value = self._root
        for step in place:
            if isinstance(value, yaml.SequenceNode) and isinstance(step, int) and step < len(value.value):
                key = value = value.value[step]
            elif isinstance(value, yaml.MappingNode):
                key, value = next(((k, v) for k, v in value.value if k.value == str(step)), (key, value))
        return key, value

    def at(self, place: Place) -> str:
        """File and line (``file:line``) of a place, or of the innermost block around it."""
        return f"{self.path}:{self.pair(place)[0].start_mark.line + 1}"

    @contextmanager
    def named_at(self, place: Place) -> Iterator[None]:
        """Let errors on what a place names, such as a file, begin with the place's line."""
        try:
            yield
        except (ValueError, FileNotFoundError) as error:
            raise type(error)(f"{self.at(place)}: {error}") from error

    def error(self, place: Place, message: str) -> ValueError:
        """Error at a place, to be raised."""
        return ValueError(f"{self.at(place)}: {message}")

    def validated(self, model: type[Model]) -> Model:
        """Document as the fields of ``model``; ``ValueError`` says what is wrong first, from the top."""
        try:
            return model.model_validate(self.data)
        except ValidationError as error:
            problems = error.errors()
        # a misspelt key is also a missing one, and the spelling is what to correct
        problems.sort(key=lambda p: (self.pair(p["loc"])[0].start_mark.line, p["type"] == "missing"))
        if any(problem["type"] == "extra_forbidden" for problem in problems):
            problems.sort(key=lambda problem: problem["type"] != "extra_forbidden")
        more = f" ({len(problems) - 1} more below)" if len(problems) > 1 else ""
        raise self.error(problems[0]["loc"], self._sentence(problems[0], model) + more)

    def _sentence(self, problem: ErrorDetails, model: type[BaseModel]) -> str:
        place = problem["loc"]
        kind = problem["type"]
        value = problem["input"]
        context = problem.get("ctx", {})
        key = str(place[-1]) if place else "the file"
        rule = re.sub("^(Input|String|List) should", "it must", problem["msg"].removeprefix("Value error, "))
        rule = rule.replace("should", "must")
        if kind == "missing" and isinstance(place[-1], int):
            return f"`{_key_of(place)}` has too few entries; it must have more than {place[-1]}: add the others"
        if kind == "missing":
            return f"`{key}` is missing; it must be given: add a line `{key}: ...`"
        if kind == "extra_forbidden":
            return f"the key `{key}` means nothing here: {similar(key, self._known_keys(place, model))}"
        if kind == "union_tag_not_found":
            return f"`type` is missing; it must be one of {', '.join(_types(model))}: add it"
        if kind == "union_tag_invalid":
            tags = [tag.strip(" '") for tag in str(context.get("expected_tags", "")).split(",")]
            return f"the type {context.get('tag')!r} is unknown: {similar(str(context.get('tag')), tags)}"
        if kind == "string_pattern_mismatch":
            rule = f"it must match {context.get('pattern')}: letters, digits, dots, dashes"
        if not place or isinstance(value, dict):
            return f"{rule}: correct this block"
        if kind == "model_attributes_type":
            rule = f"it must be a block of keys, such as `type: {_types(model)[0]}`"
        return f"`{_key_of(place)}` is {_short(repr(value))}; {rule}: correct it"

    def _known_keys(self, place: Place, model: type[BaseModel]) -> list[str]:
        """Keys that are allowed where an unknown one is, and not yet there."""
        fields = _fields_at(place[:-1], model)
        used = self.pair(place[:-1])[1]
        have = {k.value for k, _ in used.value} if isinstance(used, yaml.MappingNode) else set()
        return [name for name in fields if name not in have] or fields


def _count(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Number of values in a node with all its aliases spelt out; ``known`` has those of nodes by their ``id``."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        parts = node.value if isinstance(node, yaml.SequenceNode) else chain.from_iterable(node.value)
        known[id(node)] = 1 + sum(_count(part, known) for part in parts)
    return known[id(node)]


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:120]}..."


def _key_of(place: Place) -> str:
    """Innermost key of a place: ``angle`` of ("deformations", 0, "bend", "angle", 1)."""
    keys = [step for step in place if isinstance(step, str) and step != "[key]"]
    return keys[-1] if keys else "value"


def _types(model: type[BaseModel]) -> list[str]:
    schema = model.model_json_schema()
    return list(schema["properties"]["deformations"]["anyOf"][0]["items"]["discriminator"]["mapping"])


def _fields_at(place: Place, model: type[BaseModel]) -> list[str]:
    """Names of the fields of the block at ``place``, from the model's JSON schema."""
    schema = block = model.model_json_schema()
    for step in place:  # a key, a list's item, or the item of a named type
        if "discriminator" in block and isinstance(step, str):
            block = {"$ref": block["discriminator"]["mapping"][step]}
        else:
            block = block["items"] if isinstance(step, int) else block.get("properties", {}).get(step, block)
        block = next((option for option in block.get("anyOf", ()) if option.get("type") != "null"), block)
        if "$ref" in block:
            block = schema["$defs"][block["$ref"].rpartition("/")[2]]
    return list(block.get("properties", {}))


def similar(word: str, known: list[str]) -> str:
    """Cure for an unknown word: "did you mean ...?" where one is like it, else what is known."""
    close = nearest(word, known)
    return f"did you mean {close!r}?" if close else f"known are {', '.join(known)}"
