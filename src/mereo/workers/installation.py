"""What is installed where a task runs: results are the same bits only where code and libraries are the same."""

import hashlib
import platform
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = ("mereo", "numpy", "scipy", "torch", "embreex", "libigl", "manifold3d", "trimesh", "scikit-image")
"""Packages whose versions decide a result's last bits."""

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Installation:
    """What of an installation decides results.

    Attributes:
        versions: of Python and the packages, "none" for one that is not installed.
        code: SHA-256 of mereo's own modules: checkouts of one version may differ.
    """

    versions: tuple[tuple[str, str], ...]
    code: str

    def difference(self, other: "Installation", place: str) -> str | None:
        """Sentence on how another installation, that of a node, differs from this one; None where it does not."""
        theirs = dict(other.versions)
        for name, ours in self.versions:
            if theirs.get(name) != ours:
                return (
                    f"{place} has {name} {theirs.get(name)} and this machine {ours}; results would depend on who "
                    f"computes them: install the same there, or take another --ray"
                )
        if other.code != self.code:
            return (
                f"{place} has other code of mereo {dict(self.versions)['mereo']} than this machine; results would "
                "depend on who computes them: install the same there, or take another --ray"
            )
        return None


@cache
def installation() -> Installation:
    """This machine's installation; 2 MB of code are read for it, once."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    named = (("Python", platform.python_version()), *((name, _version(name)) for name in LIBRARIES))
    return Installation(named, digest.hexdigest())


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"
