"""Usage errors in one sentence: arguments that mean no command, what is wrong with them, and what was probably meant.

tyro prints a box of many lines. Which rule was broken it tells a hook (``tyro._errors``), which is not part of what it
promises to keep: with a tyro that has another one, or none, the words of its box are the sentence.
"""

import difflib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mereo.io.bounds import rule_of

COMMAND, OPTION = re.compile(r"^\W+• ([a-z]+)", re.MULTILINE), re.compile(r"^\W (-.*)$", re.MULTILINE)
"""Lines of a help that begin with the name of a command or an option."""

NAME = re.compile(r"(?<![\w-])--?[a-zA-Z][\w.-]*")

KINDS = {"INT": "a whole number", "FLOAT": "a number", "STR": "a text", "PATH": "a path"}
"""Words for what tyro calls the values of options."""

ALIKE = 0.65
"""Ratio of ``difflib`` from which on a name may have been meant."""

FEW = 6
"""Names that a sentence holds; more are left to the help."""


@contextmanager
def noted_events() -> Iterator[list[Any]]:
    """What tyro tells of arguments that it refuses; stays empty with a tyro that tells nothing."""
    events: list[Any] = []
    try:
        from tyro._errors import on_parse_error
    except ImportError:
        yield events
        return
    with on_parse_error(events.append):
        yield events


def usage_sentence(arguments: Sequence[str], events: Sequence[Any], box: str, help_of: Callable[..., str]) -> str:
    """Sentence about arguments that were refused.

    Args:
        arguments: all of them.
        events: from ``noted_events``.
        box: what tyro printed.
        help_of: the help of the command that these words name.
    """
    words, help_text = _command(arguments, help_of)
    name, rest = " ".join(["mereo", *words]), arguments[len(words) :]
    return f"{_complaint(name, rest, help_text, events) or _flat(box)}; see `{name} --help`"


def _complaint(name: str, rest: Sequence[str], help_text: str, events: Sequence[Any]) -> str | None:
    """Sentence about the words after a command's name, without where to find help; None where there is none."""
    if commands := COMMAND.findall(help_text):
        return _wrong_command(name, rest, commands)
    options = {found for line in OPTION.findall(help_text) for found in NAME.findall(line.split("  ")[0])}
    if unknown := [option for option in map(_option, rest) if option and option.replace("_", "-") not in options]:
        return f"{name} has no option {_quoted(unknown[0])}{_meant(unknown[0], options)}"
    try:
        return _of_event(events[-1], name, rest) if events else None
    except AttributeError:  # of a tyro whose hook tells something else
        return None


def _command(arguments: Sequence[str], help_of: Callable[..., str]) -> tuple[list[str], str]:
    """Words that name the command, as far as there is one, and its help."""
    words: list[str] = []
    while True:
        text = help_of(*words)
        following = arguments[len(words) :][:1]
        if not following or following[0] not in COMMAND.findall(text):
            return words, text
        words.append(following[0])


def _wrong_command(name: str, rest: Sequence[str], commands: Sequence[str]) -> str:
    """Sentence where the name of a command should be."""
    if rest and rest[0].startswith("-"):
        return f"{_quoted(rest[0])} comes before the command; options follow it: give the command first"
    known = f"; it must be one of {', '.join(commands)}" if len(commands) <= FEW else ""
    if not rest:
        return f"{name} is only the first word of a command{known.replace('it', 'the next', 1)}"
    return f"{name} has no command {_quoted(rest[0])}{_meant(rest[0], commands)}{known}"


def _of_event(event: Any, name: str, rest: Sequence[str]) -> str | None:
    """Sentence about what tyro told, without where to find help; None for what it may tell one day."""
    match type(event).__name__:
        case "MissingArgs":
            return _missing(name, [known.arg for known in event.missing_arguments])
        case "BadValue" if event.argument.is_positional():
            return _missing(name, [event.argument])
        case "BadValue":
            few = "too few values; they" if str(event.argument.lowered.metavar).count(" ") else "no value; it"
            return f"{event.argument.display_name()} has {few} must be {_rule(event.argument)}"
        case "InvalidChoice":
            option, meant = event.argument.display_name(), _meant(event.value, event.choices)
            return f"{option} is {_quoted(event.value)}{meant}; it must be one of {', '.join(event.choices)}"
        case "InstantiationFailure" if event.argument is not None:
            option = event.argument.display_name()
            value = _quoted(" ".join(_values(rest, option)))
            return f"{option} is {value}; it must be {_rule(event.argument)}"
        case "UnrecognizedArgs":
            return (
                f"{_quoted(event.tokens[0])} is one word too many for {name}: leave it out, or put its option before it"
            )
    return None


def _missing(name: str, known: Sequence[Any]) -> str:
    names = [f"its {a.field.intern_name}" if a.is_positional() else a.display_name() for a in known]
    said = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{name} lacks {said}: add {'it' if len(names) == 1 else 'them'}"


def _rule(argument: Any) -> str:
    """Words for what an option takes."""
    kinds = str(argument.lowered.metavar).replace("{None}|", "").strip("{}").split()
    if rule := rule_of(argument.field.type):
        return rule if "FLOAT" not in kinds else f"a number, {rule}" if len(kinds) == 1 else f"numbers, each {rule}"
    words = [KINDS.get(kind, kind) for kind in kinds]
    return words[0] if len(words) == 1 else f"{len(words)} values: {', '.join(words)}"


def _values(rest: Sequence[str], option: str) -> list[str]:
    """Words that are the value of an option where it is given last."""
    values: list[str] = []
    for number, word in enumerate(rest):
        if (_option(word) or "").replace("_", "-") == option:
            follow = rest[number + 1 :]
            end = next((n for n, other in enumerate(follow) if _option(other)), len(follow))
            values = [word.partition("=")[2]] if "=" in word else list(follow[:end])
    return values


def _option(word: str) -> str | None:
    """Name of an option, as it is written; None for other words, negative numbers among them."""
    found = NAME.match(word)
    return None if found is None else word.partition("=")[0]


def _meant(word: str, known: Sequence[str] | set[str]) -> str:
    found = difflib.get_close_matches(word.partition("=")[0], sorted(known), n=1, cutoff=ALIKE)
    return f" (did you mean {found[0]}?)" if found else ""


def _quoted(text: str) -> str:
    return repr(text) if len(text) <= 60 else f"{text[:60]!r}..."


def _flat(box: str) -> str:
    """Words of a box, in one line."""
    return " ".join(re.sub(r"[^\x00-\u24ff\u2600-\U0010ffff]", " ", box).split())[:300]
