"""Array shapes are checked in every call while tests run; files that are not in the repository are found or skipped."""

from collections.abc import Callable
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# before the first import of mereo: from here on a wrong shape or dtype is an error
install_import_hook("mereo", "type_checker.check")

from mereo.scenes import assets  # noqa: E402


def find_asset(name: str) -> Path:
    """A downloadable mesh or scan; skips the test, with the reason, where neither mirror nor network has it."""
    try:
        return assets.get(name)
    except assets.AssetUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def require_asset() -> Callable[[str], Path]:
    """``require_asset("bunny/bunny.off")`` is the file's path, or the test is skipped."""
    return find_asset


@pytest.fixture(scope="session")
def assets_dir() -> Path:
    """A folder that holds the Stanford bunny and its scans under their asset names, or the test is skipped."""
    found = [find_asset(name) for name in assets.ASSETS if name.startswith("bunny/")]
    return found[0].parent.parent
