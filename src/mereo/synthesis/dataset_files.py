"""Files of a dataset: which one they belong to, whether they are whole, and whether the disk has room for them.

Generation asks before it keeps a file of an interrupted run, training before it learns from one. All bytes are read and
digested for that, at 0.9 GB a second instead of 2: the paper's 28,800 examples take a second more. Files of earlier
versions have no checksum; of those only the shapes are compared.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float16
from pydantic import BaseModel, Field, ValidationError

from mereo.io.checked_tensors import check_tensors, read_tensors
from mereo.io.errors import first_problem, reason
from mereo.scenes.rest_pose import TEMPLATE_NODES

DECISIVE = ("scene", "segments", "nested", "any_roll", "workspace", "settings", "seed", "rest_sha256")
"""Manifest entries that decide what example i is; a scene file's text, source and unit may change without."""

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


def read_manifest(directory: Path) -> dict[str, Any]:
    """Manifest of a dataset; ``FileNotFoundError`` or ``ValueError`` with one sentence on what is wrong otherwise."""
    path = directory / "manifest.json"
    if not path.is_file():
        raise FileNotFoundError(f"{directory} has no manifest.json; a dataset is a directory made by mereo generate")
    try:
        manifest: dict[str, Any] = json.loads(path.read_text("utf-8"))
        _Manifest.model_validate(manifest)
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


def read_shard(path: Path, key: str, first: int | None = None, end: int | None = None) -> dict[str, np.ndarray]:
    """Tensors of a shard (``shards``).

    Args:
        path: the file.
        key: of the dataset.
        first: its first example, and
        end: the one after its last; None where that is not known.

    Raises ``FileNotFoundError``, and ``ValueError`` (its reason only) where it is damaged or another's.
    """
    tensors, facts = read_tensors(path, key)
    if first is not None and facts.get("first") not in (None, first):
        raise ValueError(f"it begins with example {facts['first']} instead of {first}")
    shapes = SHARD | (OBSERVED if OBSERVED.keys() & tensors.keys() else {})
    check_tensors(tensors, shapes, {} if first is None or end is None else {"e": end - first})
    return tensors


def read_template(path: Path, key: str, segments: int) -> Float16[np.ndarray, "s n n n"]:
    """Signed distances of a dataset's template for an object of so many segments; raises as ``read_shard`` does."""
    tensors, _ = read_tensors(path, key)
    check_tensors(tensors, {"distance": "s n n n"}, {"s": segments, "n": TEMPLATE_NODES})
    return tensors["distance"]


def check_space(output: Path, examples: int, each: int, machines: int) -> None:
    """Raise ``ValueError`` where examples of ``each`` bytes do not fit on the disk, beside those that are there.

    Args:
        output: the dataset's folder, which may not exist yet.
        examples: of the whole dataset.
        each: bytes of one.
        machines: that share the work; this one makes its part.
    """
    there = sum(file.stat().st_size for file in output.glob("shard-*.safetensors")) if output.is_dir() else 0
    place = next(folder for folder in (output.absolute(), *output.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free
    needed = max(0, min(examples * each - there, -(-examples // machines) * each))
    if needed > free:
        raise ValueError(
            f"--examples {examples} needs {needed / 1e9:,.1f} GB at {each / 1e3:,.1f} kB each and {output} has "
            f"{free / 1e9:,.1f} GB free; {machines * (free // each)} would fit: ask for fewer, or change --output"
        )
