"""The oldest version of every library that pyproject.toml allows, as constraints for pip.

    python .ci/lowest.py > lowest.txt && mv lowest.txt constraints.txt && CHECK=tests ./check -W default

Tools of the extras `dev` and `docs` keep the versions of constraints.txt: another formatter formats otherwise. What
libraries bring along is left open, because the old ones may not know today's.
"""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
TOOLS = ("dev", "docs")


def name_of(requirement: str) -> str:
    """The canonical name of the library in a requirement: ``types-PyYAML>=6`` is ``types-pyyaml``."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    if found is None:
        raise ValueError(f"{requirement!r} names no library; a requirement starts with its name")
    return re.sub(r"[-_.]+", "-", found.group()).lower()


def lowest(requirement: str) -> str:
    """The constraint to the lower bound: ``torch>=2.13,<3`` becomes ``torch==2.13``; one to a version stays."""
    bound = re.search(r"[>=]=\s*([A-Za-z0-9.]+)", requirement)
    if bound is None:
        raise ValueError(f"{requirement!r} has no lower bound; write the oldest version that works as >=")
    return f"{name_of(requirement)}=={bound.group(1)}"


def constraints(pyproject: str, pinned: str) -> list[str]:
    """Lower bounds of what the library and its extras need, then the pinned versions of the tools."""
    project = tomllib.loads(pyproject)["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    needed = [*project["dependencies"], *(r for name, group in extras.items() if name not in TOOLS for r in group)]
    tools = {name_of(requirement) for name in TOOLS for requirement in extras[name]}
    pins = [line for line in pinned.splitlines() if not line.startswith("#") and name_of(line) in tools]
    return sorted({lowest(requirement) for requirement in needed}) + pins


if __name__ == "__main__":
    print(*constraints((ROOT / "pyproject.toml").read_text(), (ROOT / "constraints.txt").read_text()), sep="\n")
