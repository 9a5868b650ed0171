"""Files of a dataset: which one they belong to, whether they are whole, and whether the disk has room for them.

Generation asks before it keeps a file of an interrupted run, training before it learns from one. All bytes are read and
digested for that, at 0.9 GB a second instead of 2: the paper's 28,800 examples take a second more. Files of earlier
versions have no checksum; of those only the shapes are compared.

A file's own checksum says that its bytes are those that were written. Its SHA-256 in the manifest, under ``files``,
says that they are those that the dataset had when it was complete: a whole shard that was made again by other libraries
or another version, or put in its place by hand, is noticed too. Manifests of earlier versions have none.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float16
from pydantic import BaseModel, Field, ValidationError

from mereo.io.checked_tensors import check_tensors, held_against, read_content, unpack_tensors
from mereo.io.errors import first_problem, reason
from mereo.io.object_storage import ObjectPath, Place
from mereo.io.places import names_in
from mereo.scenes.rest_pose import TEMPLATE_NODES

MANIFEST = "manifest.json"

DECISIVE = ("scene", "segments", "nested", "any_roll", "workspace", "settings", "seed", "rest_sha256")
"""Manifest entries that decide what example i is; a scene file's text, source and unit may change without."""

SHARD_NAME = re.compile(r"shard-.*\.safetensors")

SHARD = {
    "cloud": "e p 3",
    "cloud_count": "e",
    "center": "e 3",
    "scale": "e",
    "positions": "e q 3",
    "labels": "e q",
    "distances": "e q",
    "directions": "e q 3",
    "rest": "e q 3",
}
"""Tensors of a shard by their axes: e examples, p stored points, q queries."""

OBSERVED = {"seen": "e k p 3", "seen_count": "e k"}
"""Tensors that a dataset with k further observations has besides."""


class _Segment(BaseModel):
    """Segment in a manifest."""

    name: str
    color: tuple[int, int, int]


class _Sampling(BaseModel):
    """What training reads of the settings of sampling."""

    per_segment: Annotated[int, Field(ge=0)]


class _Settings(BaseModel):
    """What training reads of the settings."""

    sampling: _Sampling


class _Manifest(BaseModel):
    """What programs read of a manifest; the rest decides the dataset's key, or is for people."""

    scene: str
    seed: int
    examples: Annotated[int, Field(ge=1)]
    settings: _Settings
    segments: Annotated[tuple[_Segment, ...], Field(min_length=1, max_length=254)]
    nested: tuple[tuple[str, str], ...] = ()
    any_roll: bool
    version: str
    shard_size: Annotated[int, Field(ge=1)] | None = None
    unit_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    source: str | None = None
    files: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = {}


def read_manifest(directory: Place) -> dict[str, Any]:
    """Manifest of a dataset; ``FileNotFoundError`` or ``ValueError`` with one sentence on what is wrong otherwise."""
    path = directory / MANIFEST
    try:
        manifest: dict[str, Any] = json.loads(path.read_text("utf-8"))
        _Manifest.model_validate(manifest)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(
            f"{directory} has no {MANIFEST}; a dataset is a directory made by mereo generate"
        ) from None
    except ValidationError as error:
        raise ValueError(
            f"{path} is not the manifest of a dataset ({first_problem(error)}); generate the dataset again"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({reason(error)}); generate the dataset again") from None
    return manifest


def dataset_key(manifest: Mapping[str, Any]) -> str:
    """Digest of what decides a dataset's examples, by which its files know whose they are."""
    text = json.dumps({name: manifest.get(name) for name in DECISIVE}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def recorded_files(manifest: Mapping[str, Any]) -> Mapping[str, str]:
    """SHA-256 of a dataset's files by their names; none where a manifest of an earlier version has none.

    The manifest's own, not a copy: it is asked for each file, of which there may be a hundred thousand.
    """
    found: Mapping[str, str] = manifest.get("files", {})
    return found


def list_shards(directory: Place) -> list[Place]:
    """Shards of a dataset that are there, in their order."""
    return [directory / name for name in names_in(directory) if SHARD_NAME.fullmatch(name)]


def read_shard(
    path: Place, key: str, first: int | None = None, end: int | None = None, recorded: str | None = None
) -> dict[str, np.ndarray]:
    """Tensors of a shard (``shards``).

    Args:
        path: the file, local or of an object storage.
        key: of the dataset.
        first: its first example, and
        end: the one after its last; None where that is not known.
        recorded: its SHA-256 in the manifest (``recorded_files``), where it has one.

    Raises ``FileNotFoundError``, ``ValueError`` (its reason only) where it is damaged, another's or not the recorded
    one, and ``StorageError`` where nothing is known of it.
    """
    return unpack_shard(read_content(path, recorded), key, first, end, recorded)


def unpack_shard(
    content: bytes, key: str, first: int | None, end: int | None, recorded: str | None
) -> dict[str, np.ndarray]:
    """Tensors of a shard from its content; raises as ``read_shard`` does."""
    with held_against(content, recorded) as verified:
        tensors, facts = unpack_tensors(content, key, verified)
        if first is not None and facts.get("first") not in (None, first):
            raise ValueError(f"it begins with example {facts['first']} instead of {first}")
        shapes = SHARD | (OBSERVED if OBSERVED.keys() & tensors.keys() else {})
        check_tensors(tensors, shapes, {} if first is None or end is None else {"e": end - first})
    return tensors


def read_template(path: Place, key: str, segments: int, recorded: str | None = None) -> Float16[np.ndarray, "s n n n"]:
    """Signed distances of a dataset's template for an object of so many segments; raises as ``read_shard`` does."""
    return unpack_template(read_content(path, recorded), key, segments, recorded)


def unpack_template(content: bytes, key: str, segments: int, recorded: str | None) -> Float16[np.ndarray, "s n n n"]:
    """Template from its file's content; raises as ``read_shard`` does."""
    with held_against(content, recorded) as verified:
        tensors, _ = unpack_tensors(content, key, verified)
        check_tensors(tensors, {"distance": "s n n n"}, {"s": segments, "n": TEMPLATE_NODES})
    return tensors["distance"]


def check_space(output: Place, examples: int, each: int, machines: int) -> None:
    """Raise ``ValueError`` where examples of ``each`` bytes do not fit on the disk, beside those that are there.

    An object storage tells no free space.

    Args:
        output: the dataset's folder, which may not exist yet.
        examples: of the whole dataset.
        each: bytes of one.
        machines: that share the work; this one makes its part.
    """
    if isinstance(output, ObjectPath):
        return
    there = sum(file.stat().st_size for file in output.glob("shard-*.safetensors")) if output.is_dir() else 0
    place = next(folder for folder in (output.absolute(), *output.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free
    needed = max(0, min(examples * each - there, -(-examples // machines) * each))
    if needed > free:
        raise ValueError(
            f"--examples {examples} needs {needed / 1e9:,.1f} GB at {each / 1e3:,.1f} kB each and {output} has "
            f"{free / 1e9:,.1f} GB free; {machines * (free // each)} would fit: ask for fewer, or change --output"
        )
