"""The commands ``mereo weights push`` and ``pull``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path

from mereo.cli.options import RepositoryName, WeightsName


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
        from mereo.cli.weights_hub import push

        push(self.weights, self.repository, self.private)


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
        from mereo.cli.weights_hub import pull

        pull(self.repository, self.output, self.force)
