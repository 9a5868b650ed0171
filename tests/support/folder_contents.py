"""Contents of a folder."""

import json
from pathlib import Path
from typing import Any


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}


def read_json(file: Path) -> Any:
    return json.loads(file.read_text("utf-8"))
