"""What a dataset's folder must hold, whether it does, and the SHA-256 of each file in its manifest.

A manifest is written before the first shard, and shards are made by any number of machines in any order. Whoever finds
the last one done writes the manifest again with ``files``, the SHA-256 of each file by its name. All write the same
bytes then, since each file's bytes depend on the manifest alone: two at a time do no harm, and one that is killed
leaves a dataset without ``files``, which is as good as those of earlier versions and gets them when it is continued.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mereo.io.atomic_files import json_text
from mereo.io.checked_tensors import read_content
from mereo.io.object_storage import Place
from mereo.io.places import names_in, sha256, write_whole
from mereo.io.progress import progress
from mereo.scenes.seeds import TEST_SEED_START
from mereo.scenes.statistical_model_file import read_statistical_model
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo.synthesis.dataset_files import (
    MANIFEST,
    SHARD_NAME,
    dataset_key,
    read_manifest,
    recorded_files,
    unpack_shard,
    unpack_template,
)

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
