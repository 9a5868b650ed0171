"""Contents of folders, commands that fill them, and refusals of what is in them."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mereo import __main__ as command_line


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}


def read_json(file: Path) -> Any:
    return json.loads(file.read_text("utf-8"))


def run_mereo(*words: object) -> int:
    """Exit code of a command."""
    return command_line.main([str(word) for word in words])


@contextmanager
def refusal(match: str, error: type[Exception] = ValueError) -> Iterator[None]:
    """Expect an error of one line."""
    with pytest.raises(error, match=match) as caught:
        yield
    assert "\n" not in str(caught.value)
