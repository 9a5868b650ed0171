"""Fails unless a tag is the version that pyproject.toml and the changelog state: ``python .ci/version.py v1.2.3``."""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def disagreement(tag: str, pyproject: str, changelog: str) -> str:
    """What keeps a tag from being a release, as a sentence; nothing where it is one."""
    version = tomllib.loads(pyproject)["project"]["version"]
    if tag != f"v{version}":
        return f"the tag is {tag} and pyproject.toml states {version}: tag v{version}, or raise the version"
    dated = re.search(rf"^## {re.escape(version)} - (\d{{4}}-\d{{2}}-\d{{2}})$", changelog, re.MULTILINE)
    return "" if dated else f"CHANGELOG.md has no dated heading of {version}: write '## {version} - YYYY-MM-DD'"


if __name__ == "__main__":
    sys.exit(disagreement(sys.argv[1], (ROOT / "pyproject.toml").read_text(), (ROOT / "CHANGELOG.md").read_text()))
