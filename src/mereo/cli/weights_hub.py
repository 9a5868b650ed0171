"""Weights on a model hub: ``mereo weights push`` and ``mereo weights pull``.

huggingface_hub does the transfer, with its logins (``hf auth login``, ``HF_TOKEN``) and its ``HF_ENDPOINT``. Only
a safetensors file and its card in Markdown travel: what is pulled is read by ``load_model``, which runs nothing of it.
"""

import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.errors import check_bytes, reason
from mereo.models.weights import load_model
from mereo.models.weights_place import find_weights

ENDPOINT = "https://huggingface.co"

SYNTAX = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+?))?(/(?P<file>[\w.-]+\.safetensors))?")

MOST_CARD_BYTES = 1_000_000
"""Size of a model card at most."""

HEAD = "---\nlibrary_name: mereo\ntags: [point-cloud, 3d-reconstruction, segmentation]\n---\n\n"
"""What a hub reads of a repository's page before its text."""


@dataclass(frozen=True)
class Place:
    """Place of weights on a hub.

    Attributes:
        repo: OWNER/NAME.
        revision: branch, tag or commit; None is the main branch.
        file: name of the weights; None where the repository, or the weights, say it.
    """

    repo: str
    revision: str | None
    file: str | None

    @classmethod
    def parse(cls, text: str) -> "Place":
        """Place from ``OWNER/NAME[@REVISION][/FILE.safetensors]``; ``ValueError`` for another text."""
        found = SYNTAX.fullmatch(text)
        if found is None:
            raise ValueError(
                f"{text!r} names no repository; write OWNER/NAME, OWNER/NAME@REVISION or OWNER/NAME/FILE.safetensors"
            )
        return cls(**found.groupdict())

    def __str__(self) -> str:
        return self.repo if self.revision is None else f"{self.repo}@{self.revision}"


def push(weights: str, repository: str, private: bool = False) -> None:
    """Upload weights and the card beside them in one commit; a repository that is not there is made.

    Args:
        weights: a shipped name or a file.
        repository: as ``Place.parse`` reads it; the revision is a branch that exists.
        private: of a new repository.

    Raises ``ValueError`` for no weights, ``FileNotFoundError`` without a card, ``ImportError`` without the extra `hub`,
    and ``OSError`` where the hub cannot be reached or refuses.
    """
    place, path = Place.parse(repository), find_weights(weights)
    load_model(path)
    card = path.with_suffix(".md")
    if not card.is_file():
        raise FileNotFoundError(
            f"{path} has no card {card.name} beside it; write both with `mereo release`, which leaves out the places "
            "of this machine, and push those"
        )
    hub, api = _hub()
    name = place.file or path.name
    page = card.read_bytes()
    files = {name: path.read_bytes(), Path(name).with_suffix(".md").name: page}
    with _explained(place):
        api.create_repo(place.repo, private=private, exist_ok=True)
        if not api.file_exists(place.repo, "README.md", revision=place.revision):
            files["README.md"] = HEAD.encode() + page
        added = [hub.CommitOperationAdd(file, content) for file, content in files.items()]
        api.create_commit(place.repo, added, commit_message=f"Add {name}", revision=place.revision)
    print(f"pushed {', '.join(files)} to {place}; anyone who may read it: mereo weights pull {place}/{name}")


def pull(repository: str, output: Path, force: bool = False) -> Path:
    """Download weights and their card, check them, and put them into a folder; returns the weights' path.

    Args:
        repository: as ``Place.parse`` reads it.
        output: the folder.
        force: replace existing files.

    Raises ``FileExistsError`` as ``atomic_file`` does, ``ValueError`` for weights that ``load_model`` refuses or that
    are over the limit, ``ImportError`` without the extra `hub`, and ``OSError`` where the hub cannot be reached or
    refuses.
    """
    place = Place.parse(repository)
    _, api = _hub()
    with tempfile.TemporaryDirectory() as folder:
        with _explained(place):
            info = api.model_info(place.repo, revision=place.revision, files_metadata=True)
            sizes = {file.rfilename: file.size or 0 for file in info.siblings or ()}
            name = _chosen(place, sizes)
            card = Path(name).with_suffix(".md").name
            wanted = [card, name] if card in sizes else [name]
            for file in wanted:
                check_file_place(output / file, force=force)
            check_bytes(f"{place}/{name}", sizes[name])
            if sizes.get(card, 0) > MOST_CARD_BYTES:
                raise ValueError(f"{place}/{card} has {sizes[card] / 1e6:.1f} MB, which is no model card: report it")
            for file in wanted:
                api.hf_hub_download(place.repo, file, revision=info.sha, local_dir=folder)
        load_model(Path(folder) / name)
        for file in wanted:
            with atomic_file(output / file, force=force) as partial:
                partial.write_bytes((Path(folder) / file).read_bytes())
    print(f"wrote {' and '.join(str(output / file) for file in wanted)} ({place}, commit {str(info.sha)[:12]})")
    return output / name


def _chosen(place: Place, sizes: Mapping[str, int]) -> str:
    """Name of the weights in a repository with these files."""
    there = sorted(name for name in sizes if name.endswith(".safetensors") and "/" not in name)
    if place.file in there:
        return place.file
    if place.file is None and len(there) == 1:
        return there[0]
    what = "several weights" if place.file is None and there else f"no weights {place.file or ''}".rstrip()
    raise ValueError(f"{place} holds {what}; " + (f"name one: {', '.join(there)}" if there else "check its name"))


def _hub() -> tuple[Any, Any]:
    """huggingface_hub and a client of it; ``ImportError`` names the extra."""
    try:
        import huggingface_hub
    except ImportError:
        raise ImportError("huggingface_hub is needed for model hubs: pip install 'mereo[hub]'") from None
    import_module("huggingface_hub.utils").disable_progress_bars()
    # by ourselves, because huggingface_hub reads the variable only when it is imported
    return huggingface_hub, huggingface_hub.HfApi(endpoint=_endpoint(), library_name="mereo")


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "").rstrip("/") or ENDPOINT


@contextmanager
def _explained(place: Place) -> Iterator[None]:
    """Say in one sentence what a hub has against it."""
    errors: Any = import_module("huggingface_hub.errors")  # it names errors of its HTTP client that it does not export
    log_in = "log in with `hf auth login` or set HF_TOKEN"
    try:
        yield
    except errors.RepositoryNotFoundError:
        raise OSError(f"{_endpoint()} shows no repository {place.repo}: check its name, or {log_in}") from None
    except errors.RevisionNotFoundError:
        raise OSError(f"{place.repo} has no revision {place.revision}: name a branch, tag or commit of it") from None
    except errors.HFValidationError as error:
        raise ValueError(f"{place} is no name of a repository: {' '.join(str(error).split())}") from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        cure = log_in if status in (401, 403) else "try again later"
        raise OSError(f"{_endpoint()} refuses what is asked of {place} (HTTP {status}): {cure}") from None
    except (errors.HTTPError, errors.OfflineModeIsEnabled, errors.LocalEntryNotFoundError) as error:
        raise OSError(
            f"{_endpoint()} cannot be reached ({type(error).__name__}): check the network and HF_ENDPOINT, or carry "
            "the .safetensors file over by hand"
        ) from None
    except RuntimeError as error:  # of an upload
        why = reason(error.__cause__ if isinstance(error.__cause__, Exception) else error)
        raise OSError(f"the transfer to {_endpoint()} broke off ({why}): try again") from None
