"""Last resort of the command line: one line for what no part of mereo has foreseen."""

from pathlib import Path

from mereo.io.foreseen import words_of

NO_MEMORY = ("out of memory", "can't allocate memory", "bad_alloc")
"""What torch and compiled libraries say where Python has a ``MemoryError``."""


def sentence(error: Exception, arguments: list[str], variable: str) -> str:
    """Line about an unforeseen error: the command, the files that its arguments name, the error, and what to do.

    Args:
        error: whatever it is.
        arguments: of the command line.
        variable: of the environment, by which the traceback is shown.
    """
    what = words_of(error)
    where = f"{_command(arguments)}: {what}"
    if isinstance(error, MemoryError) or any(words in what.lower() for words in NO_MEMORY):
        return f"{where}; the memory does not suffice: ask for less (resolution, points, batch, workers) or free some"
    if isinstance(error, RecursionError):
        return f"{where}; something is nested too deeply, or in itself: look into the files that are named"
    whose = "mereo, or of the Python file" if any(word.endswith(".py") for word in arguments) else "mereo"
    return f"{where}; this is a fault of {whose}: run it again with {variable}=1, and report the text that it prints"


def _command(arguments: list[str]) -> str:
    """Names of the command and of the existing files among its arguments: ``mereo align on scan.ply``."""
    words = next((n for n, word in enumerate(arguments) if not word.isalpha()), len(arguments))
    named = arguments[:1] if words < 2 or arguments[0] not in ("scene", "assets", "dataset") else arguments[:2]
    values = [word.partition("=")[2] if word.startswith("--") else word for word in arguments[len(named) :]]
    files = [value for value in values if value and _is_there(value)]
    return " ".join(["mereo", *named, *(["on", ", ".join(files)] if files else [])])


def _is_there(value: str) -> bool:
    try:
        return Path(value).exists()
    except (OSError, ValueError):  # a name that is too long, or has a zero in it
        return False
