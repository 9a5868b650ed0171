"""What a dataset's folder must hold, whether it does, and the SHA-256 of each file in its manifest.

A manifest is written before the first shard, and shards are made by any number of machines in any order. Whoever finds
the last one done writes the manifest again with ``files``, the SHA-256 of each file by its name. All write the same
bytes then, since each file's bytes depend on the manifest alone: two at a time do no harm, and one that is killed
leaves a dataset without ``files``, which is as good as those of earlier versions and gets them when it is continued.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float16
from pydantic import BaseModel, Field, ValidationError

from mereo.io.atomic_files import json_text
from mereo.io.checked_tensors import check_tensors, held_against, read_content, unpack_tensors
from mereo.io.errors import first_problem, reason
from mereo.io.object_storage import ObjectPath, Place, names_in, sha256, write_whole
from mereo.io.progress import progress
from mereo.scenes.rest_pose import TEMPLATE_NODES
from mereo.scenes.seeds import TEST_SEED_START
from mereo.scenes.statistical_model import read_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE

FILES = "files"
"""Manifest entry with the SHA-256 of each file."""


def shard_name(number: int) -> str:
    """Name of a shard's file."""
    return f"shard-{number:05d}.safetensors"


@dataclass(frozen=True, eq=False)
class DatasetContents:
    """Files of a dataset, as they are found and written.

    Attributes:
        folder: of the dataset.
        manifest: what it holds.
        there: names of its files at first.
        shard_size: examples of a whole shard; None for datasets of early versions, which do not say it.
        known: SHA-256 of the files that were read and found whole, or written, by their names.
        examples: number of examples in each shard that was read.
    """

    folder: Place
    manifest: dict[str, Any]
    there: frozenset[str]
    shard_size: int | None
    known: dict[str, str] = field(default_factory=dict)
    examples: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Place, shard_size: int | None = None) -> "DatasetContents":
        """Contents of a folder; ``shard_size`` holds where its manifest has none. Raises as ``read_manifest`` does."""
        manifest = read_manifest(folder)
        return cls(folder, manifest, frozenset(names_in(folder)), manifest.get("shard_size") or shard_size)

    @property
    def expected(self) -> list[str]:
        """Names of the files that the dataset must have, but for its manifest."""
        if self.shard_size is None:
            shards = sorted(filter(SHARD_NAME.fullmatch, self.there.union(recorded_files(self.manifest))))
        else:
            shards = [shard_name(number) for number in range(-(-self.manifest["examples"] // self.shard_size))]
        # nothing is trained on a test set
        models = [] if self.manifest["seed"] >= TEST_SEED_START else [STATISTICAL_MODEL]
        return [TEMPLATE, *models, *shards]

    def check(self, name: str) -> None:
        """Read a file of the dataset and note its SHA-256.

        Raises ``FileNotFoundError``, ``ValueError`` (its reason only) where it is damaged, another dataset's or not the
        recorded one, and ``StorageError`` where nothing is known of it.
        """
        content = read_content(self.folder / name)
        found = self._reader(name)(content, recorded_files(self.manifest).get(name))
        if isinstance(found, dict):
            self.examples[name] = len(found["cloud"])
        self.known[name] = sha256(content)

    def _reader(self, name: str) -> Callable[[bytes, str | None], object]:
        key, manifest = dataset_key(self.manifest), self.manifest
        if name == TEMPLATE:
            return lambda content, recorded: unpack_template(content, key, len(manifest["segments"]), recorded)
        if name == STATISTICAL_MODEL:
            return lambda content, recorded: read_statistical_model(content, key, recorded)
        first, end = self._span(name)
        return lambda content, recorded: unpack_shard(content, key, first, end, recorded)

    def _span(self, name: str) -> tuple[int, int] | tuple[None, None]:
        """First example of a shard, and the one after its last; unknown for datasets of early versions."""
        number = name.removeprefix("shard-").partition(".")[0]
        if self.shard_size is None or not number.isdecimal():
            return None, None
        first = int(number) * self.shard_size
        return first, min(self.manifest["examples"], first + self.shard_size)

    def keeps(self, name: str) -> bool:
        """Whether a file is there and whole; one that a crash cut off or that was changed since is reported."""
        if name not in self.there:
            return False
        try:
            self.check(name)
        except FileNotFoundError:
            return False
        except ValueError:
            print(f"{name} is damaged and is made again", flush=True)
            return False
        return True

    def write(self, name: str, content: bytes) -> None:
        """Write a file of the dataset, whole or not at all."""
        self.known[name] = write_whole(self.folder / name, content)

    def finish(self) -> None:
        """Record the SHA-256 of each file, if all files are there by now; what others made is read for that.

        Of a file that is not whole it is said, and nothing is written.
        """
        if not frozenset(names_in(self.folder)).issuperset(self.expected):
            return  # others still work
        for name in self.expected:
            if name in self.known:
                continue
            try:
                self.check(name)
            except (ValueError, FileNotFoundError) as error:
                print(f"{name} is damaged ({error}); run the same command again with --resume", flush=True)
                return
        self.record(self.expected)

    def record(self, names: list[str]) -> None:
        """Write the SHA-256 of these files, all of which are known, into the manifest, where it has not got them."""
        recorded = {name: self.known[name] for name in names}
        if recorded_files(self.manifest) != recorded:
            write_whole(self.folder / MANIFEST, json_text({**self.manifest, FILES: recorded}).encode())


# --- check ------------------------------------------------------------------------------------------------------------

# Reading all of a dataset: which of its files are missing or wrong, and why.

CURE = "the `mereo generate` command that made it, with --resume, makes just these again"


def check_dataset(folder: Place, write: bool = False) -> DatasetContents:
    """Read every file of a dataset and print each that is missing, wrong or too many, with the reason.

    Args:
        folder: of the dataset.
        write: write the SHA-256 of each file into a manifest that has none, if all are good.

    Raises ``ValueError`` where a file is not good, or the folder holds no dataset, ``FileNotFoundError`` where there is
    none, and ``StorageError`` where the storage refuses.
    """
    contents = DatasetContents.of(folder)
    problems, files = dict[str, str](), [name for name in contents.expected if not _may_lack(contents, name)]
    with progress("check", len(files), "files") as shown:
        for name in files:
            if name not in contents.there:
                problems[name] = "it is missing"
            else:
                try:
                    contents.check(name)
                except (FileNotFoundError, ValueError) as error:
                    problems[name] = "it is missing" if isinstance(error, FileNotFoundError) else str(error)
            shown.advance(1)
    spare = sorted(name for name in contents.there.difference(files) if SHARD_NAME.fullmatch(name))
    for name, why in problems.items():
        print(f"{name}: {why}")
    for name in spare:
        print(f"{name}: it is no part of this dataset, which ends before it")
    if problems:
        raise ValueError(f"{folder}: {len(problems)} of {len(files)} files are not good; {CURE}")
    if spare:
        raise ValueError(
            f"{folder}: {len(spare)} files are not of this dataset; move {'them' if spare[1:] else 'it'} away"
        )
    have, examples = sum(contents.examples.values()), contents.manifest["examples"]
    if have != examples:  # a manifest of an early version does not say how many shards there are
        raise ValueError(f"{folder} holds {have} of {examples} examples; {CURE}")
    print(f"{folder}: all {len(files)} files are whole, {examples} examples; {_hashes(contents, files, write)}")
    return contents


def _may_lack(contents: DatasetContents, name: str) -> bool:
    """Whether a file is not there and need not be: earlier versions made datasets without these, and without hashes."""
    optional = name in (TEMPLATE, STATISTICAL_MODEL) and name not in recorded_files(contents.manifest)
    return optional and name not in contents.there


def _hashes(contents: DatasetContents, files: list[str], write: bool) -> str:
    """Words on the SHA-256 in the manifest, which are written where that is asked for."""
    if recorded_files(contents.manifest):
        return "each has the SHA-256 that manifest.json has for it"
    if not write:
        return "manifest.json has no SHA-256 of them: --write adds them"
    contents.record(files)
    return "wrote the SHA-256 of each into manifest.json"


# --- files of a dataset -----------------------------------------------------------------------------------------------

# Files of a dataset: which one they belong to, whether they are whole, and whether the disk has room for them.
#
# Generation asks before it keeps a file of an interrupted run, training before it learns from one. All bytes are read
# and digested for that, at 0.9 GB a second instead of 2: the paper's 28,800 examples take a second more. Files of
# earlier versions have no checksum; of those only the shapes are compared.
#
# A file's own checksum says that its bytes are those that were written. Its SHA-256 in the manifest, under ``files``,
# says that they are those that the dataset had when it was complete: a whole shard that was made again by other
# libraries or another version, or put in its place by hand, is noticed too. Manifests of earlier versions have none.

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
    return unpack_shard(read_content(path), key, first, end, recorded)


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
    return unpack_template(read_content(path), key, segments, recorded)


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
