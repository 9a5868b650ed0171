"""The commands of weights: list, show, push and pull, calibrate, release."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from mereo.cli.options import Outcome, RepositoryName, WeightsFiles, WeightsName
from mereo.io.bounds import Count, CountOrNone, Threads

SCORES = re.compile(r"^\| ([\d.-]+) \| ([\d.-]+) \|", re.MULTILINE)
"""IoU and mIoU in a row of a model card."""

REPOSITORY = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+?))?(/(?P<file>[\w.-]+\.safetensors))?")

PAGE_HEAD = "---\nlibrary_name: mereo\ntags: [point-cloud, 3d-reconstruction, segmentation]\n---\n\n"
"""What a hub reads of a repository's page before its text."""


@dataclass(frozen=True)
class WeightsList:
    """Name the shipped weights, each with its object, size and scores.

    Attributes:
        weights: files, or folders of them, to list instead of the shipped ones.
    """

    weights: WeightsFiles = ()

    def run(self) -> None:
        """Print a row for each file of weights."""
        from rich.console import Console
        from rich.table import Table

        from mereo.models.weights_place import SHIPPED, read_facts, shipped_names

        table = Table(title=None if self.weights else f"weights in {SHIPPED}", title_justify="left")
        for column in ("name", "object", "segments", "size", "IoU mIoU"):
            table.add_column(column, overflow="fold")
        for name in [file for place in self.weights for file in _weights_in(place)] or shipped_names():
            path, header = read_facts(name)
            card = path.with_suffix(".md")
            scores = SCORES.search(card.read_text("utf-8")) if card.is_file() else None
            table.add_row(
                str(name),
                str(header["provenance"].get("scene") or "unknown"),
                str(len(header["names"])),
                f"{path.stat().st_size / 2**20:.1f} MB",
                "" if scores is None else " ".join(scores.groups()),
            )
        Console(markup=False, emoji=False).print(table)
        print("IoU of all segments as one, mIoU of each, in the first test of the card: mereo weights show NAME")


@dataclass(frozen=True)
class WeightsShow:
    """Say what weights know: object, segments, unit, network, statistical model, training, scores and limits.

    Attributes:
        weights: a shipped name or a file.
        json: print everything as JSON, recipe and settings included.
    """

    weights: WeightsName
    json: bool = False

    def run(self) -> Outcome:
        """Print what the file and its card say."""
        from hashlib import sha256

        from mereo.models.weights_place import read_facts
        from mereo.scenes.scene import SourceFrame

        path, header = read_facts(self.weights)
        content, card = path.read_bytes(), path.with_suffix(".md")
        digest = sha256(content).hexdigest()
        frame = SourceFrame.of_facts((header.get("states") or {}).get("frame"))
        unit_m = None if frame is None else frame.unit_m
        if card.is_file():
            text = card.read_text("utf-8")
        else:
            from mereo.models.weights import load_model
            from mereo.training.model_card import card as card_of

            text = card_of(path.stem, load_model(path), [], content)
        if not self.json:
            print(f"weights  {path}, {len(content) / 2**20:.1f} MB, format {header.get('version')}\nSHA-256  {digest}")
            print("unit     " + (f"{1000 * unit_m:.4g} mm to a scene unit" if unit_m else "true size not known"))
            print(f"\n{text}")
        facts = {"path": str(path.absolute()), "bytes": len(content), "sha256": digest, **header}
        return Outcome({**facts, "unit_m": unit_m, "card": text})


def _weights_in(place: Path) -> list[Path]:
    """Files of weights that a place is or holds; a checkpoint of a training is none."""
    if not place.is_dir():
        return [place]
    from mereo.models.weights_place import read_facts

    found = []
    for file in sorted(place.rglob("*.safetensors")):
        with suppress(ValueError):
            read_facts(file)
            found.append(file)
    if not found:
        raise ValueError(f"{place} holds no weights; name a .safetensors file of mereo train, or a folder of such")
    return found


@dataclass(frozen=True)
class WeightsPush:
    """Put released weights and their model card into a repository of a model hub (Hugging Face, or HF_ENDPOINT).

    Log in before with `hf auth login`, or set HF_TOKEN.

    Attributes:
        weights: a shipped name, or a file of `mereo release` with its card beside it.
        repository: OWNER/NAME, OWNER/NAME@BRANCH, and /FILE.safetensors behind it for another name of the file.
        private: where the repository is new, only its owner sees it.
    """

    weights: WeightsName
    repository: RepositoryName
    private: bool = False

    def run(self) -> None:
        """Check the weights, upload both files in one commit, and print where they are."""
        from mereo.models.weights import load_model
        from mereo.models.weights_place import find_weights

        (repo, revision, file), path = _repository(self.repository), find_weights(self.weights)
        load_model(path)
        card = path.with_suffix(".md")
        if not card.is_file():
            raise FileNotFoundError(
                f"{path} has no card {card.name} beside it; write both with `mereo release`, which leaves out the "
                "places of this machine, and push those"
            )
        name = file or path.name
        files = {name: path.read_bytes(), Path(name).with_suffix(".md").name: card.read_bytes()}
        with _hub(self.repository) as (hub, api):
            api.create_repo(repo, private=self.private, exist_ok=True)
            if not api.file_exists(repo, "README.md", revision=revision):
                files["README.md"] = PAGE_HEAD.encode() + card.read_bytes()
            added = [hub.CommitOperationAdd(each, content) for each, content in files.items()]
            api.create_commit(repo, added, commit_message=f"Add {name}", revision=revision)
        print(f"pushed {', '.join(files)} to {repo}; anyone who may read it: mereo weights pull {self.repository}")


@dataclass(frozen=True)
class WeightsPull:
    """Fetch weights and their model card from a repository of a model hub (Hugging Face, or HF_ENDPOINT).

    The file is read whole before it is put in place, and nothing that a repository holds is ever run.

    Attributes:
        repository: OWNER/NAME, OWNER/NAME@REVISION (branch, tag, commit), and /FILE.safetensors where it holds several.
        output: folder for both files.
        force: replace existing files.
    """

    repository: RepositoryName
    output: Path = Path()
    force: bool = False

    def run(self) -> None:
        """Download, check, and print what was written."""
        from tempfile import TemporaryDirectory

        from mereo.io.atomic_files import atomic_file, check_file_place
        from mereo.io.errors import check_bytes
        from mereo.models.weights import load_model

        repo, revision, file = _repository(self.repository)
        with TemporaryDirectory() as folder:
            with _hub(self.repository) as (_, api):
                info = api.model_info(repo, revision=revision, files_metadata=True)
                sizes = {each.rfilename: each.size or 0 for each in info.siblings or ()}
                names = sorted(name for name in sizes if name.endswith(".safetensors") and file in (None, name))
                if len(names) != 1:
                    raise ValueError(
                        f"{self.repository} holds {', '.join(names) or 'no such weights'}; name one file of the "
                        f"repository: {repo}/FILE.safetensors"
                    )
                wanted = [name for name in (Path(names[0]).with_suffix(".md").name, names[0]) if name in sizes]
                for name in wanted:
                    check_file_place(self.output / name, force=self.force)
                    check_bytes(f"{repo}/{name}", sizes[name])
                for name in wanted:
                    api.hf_hub_download(repo, name, revision=info.sha, local_dir=folder)
            load_model(Path(folder) / names[0])
            for name in wanted:
                with atomic_file(self.output / name, force=self.force) as partial:
                    partial.write_bytes((Path(folder) / name).read_bytes())
        print(f"wrote {' and '.join(str(self.output / name) for name in wanted)} ({repo}, commit {str(info.sha)[:12]})")


def _repository(text: str) -> tuple[str, str | None, str | None]:
    """Name, revision and file of ``OWNER/NAME[@REVISION][/FILE.safetensors]``; ``ValueError`` for another text."""
    match = REPOSITORY.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{text!r} names no repository; write OWNER/NAME, OWNER/NAME@REVISION or OWNER/NAME/FILE.safetensors"
        )
    return match["repo"], match["revision"], match["file"]


@contextmanager
def _hub(repository: str) -> Iterator[tuple[Any, Any]]:
    """huggingface_hub and a client of it; what it raises in the block is one sentence."""
    from mereo.io.errors import reason

    try:
        hub = import_module("huggingface_hub")
    except ImportError:
        raise ImportError("huggingface_hub is needed for model hubs: pip install 'mereo[hub]'") from None
    errors = import_module("huggingface_hub.errors")  # it names errors of its HTTP client that it does not export
    import_module("huggingface_hub.utils").disable_progress_bars()
    try:
        yield hub, hub.HfApi(endpoint=os.environ.get("HF_ENDPOINT") or None, library_name="mereo")
    except (
        errors.HTTPError,
        errors.HFValidationError,
        errors.LocalEntryNotFoundError,
        ConnectionError,
        RuntimeError,
    ) as error:
        raise OSError(
            f"{repository} cannot be reached on its hub ({type(error).__name__}: {reason(error)}): check its name, the "
            "network and HF_ENDPOINT, and log in with `hf auth login` or set HF_TOKEN"
        ) from None


@dataclass(frozen=True)
class CalibrateCommand:
    """Measure how far the answers of weights can be trusted, on views of training seeds, and write it into them.

    Probabilities are scaled so that they are as often right as they say, so are the radii within which the registered
    model says that true places lie, and the limits are set from which on a frame is said to show something else than
    the object, or a state that was not learned.

    Attributes:
        weights: a shipped name or a file.
        output: file to write; by default the weights' own, which --force replaces.
        scene: the scene's name or file, where it is not the built-in one that the weights were trained on.
        views: of the object, half of them clean; about as many frames of other things come on top.
        radius_views: further clean views of the object for the radii alone; 0 for none.
        seed: a training seed, below 1,000,000, other than that of the weights' examples.
        force: replace an existing file.
        threads: of torch and all else that computes; 0 means one per core, and 1 helps on a busy machine.
    """

    weights: WeightsName
    output: Path | None = None
    scene: str | None = None
    views: Count = 48
    radius_views: CountOrNone = 32
    seed: CountOrNone = 900_000
    force: bool = False
    threads: Threads = 0

    def run(self) -> None:
        """Measure, write the weights anew, and print what was found."""
        from mereo.evaluation.calibrate import calibrate
        from mereo.io.atomic_files import atomic_file
        from mereo.models.calibration import calibration_rows
        from mereo.models.weights import load_model, with_calibration
        from mereo.models.weights_place import find_weights
        from mereo.scenes.registry import files_of

        path = find_weights(self.weights)
        output = self.output or path
        with atomic_file(output, force=self.force, inputs=files_of(self.scene) if self.scene else []) as partial:
            found = calibrate(
                load_model(self.weights),
                self.scene,
                views=self.views,
                seed=self.seed,
                radius_views=self.radius_views,
                quiet=False,
            )
            partial.write_bytes(with_calibration(path, found))
        for title, value in calibration_rows(found):
            print(f"{title:<14} {value}")
        print(f"wrote {output}")


@dataclass(frozen=True)
class Release:
    """Write weights to hand on: in float16, with a model card of what they know, how they were trained and tested.

    Attributes:
        weights: a shipped name or a file.
        name: of the files: lower case letters, digits, - and _.
        output: folder to create.
        tests: folders that `mereo evaluate` has written for these weights; their scores go into the card.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    weights: WeightsName
    name: str
    output: Path
    tests: tuple[Path, ...] = ()
    force: bool = False

    def run(self) -> None:
        """Write the weights to hand on, and their model card."""
        from mereo.training.model_card import release

        release(self.weights, self.name, self.output, self.tests, self.force)
