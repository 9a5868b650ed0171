"""Reading all of a dataset: which of its files are missing or wrong, and why."""

from mereo.io.object_storage import Place
from mereo.io.progress import progress
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE
from mereo.synthesis.dataset_contents import DatasetContents
from mereo.synthesis.dataset_files import SHARD_NAME, recorded_files

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
