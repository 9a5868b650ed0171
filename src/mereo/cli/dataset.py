"""``mereo dataset show``: what a dataset is, as lines."""

from collections.abc import Iterator
from typing import Any

from mereo.io.object_storage import Place
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.dataset_contents import DatasetContents, recorded_files


def show_dataset(folder: Place) -> None:
    """Print what a dataset is, and how much of it is there; raises as ``read_manifest`` does."""
    for name, value in _facts(DatasetContents.of(folder)):
        print(f"{name:<14} {value}")


def _facts(contents: DatasetContents) -> Iterator[tuple[str, str]]:
    manifest, files = contents.manifest, contents.expected
    there = sum(name in contents.there for name in files)
    yield "dataset", str(contents.folder)
    yield "scene", f"{manifest['scene']}, of {', '.join(segment['name'] for segment in manifest['segments'])}"
    test = ", which is for testing" if manifest["seed"] >= TEST_SEED_START else ""
    yield "seed", f"{manifest['seed']}{test}"
    yield "examples", f"{manifest['examples']}{_size(manifest)}"
    yield "files", f"{there} of {len(files)} are there"
    hashes = (
        "of each file in the manifest" if recorded_files(manifest) else "not recorded: `mereo dataset check --write`"
    )
    yield "SHA-256", hashes
    yield "made by", f"mereo {manifest['version']}"
    yield from _flat(manifest["settings"], "")


def _size(manifest: dict[str, Any]) -> str:
    return f", {manifest['bytes'] / 1e6:,.1f} MB" if "bytes" in manifest else ""


def _flat(settings: dict[str, Any], prefix: str) -> Iterator[tuple[str, str]]:
    """Settings by the names of their options."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)
