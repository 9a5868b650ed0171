"""The commands ``mereo dataset ...``: check and show. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass

from mereo.cli.options import DatasetFolder


@dataclass(frozen=True)
class DatasetCheck:
    """Read all of a dataset, and name every file that is missing or wrong, with the reason.

    Attributes:
        dataset: folder written by `mereo generate`, or its URL in an object storage.
        write: write the SHA-256 of each file into the manifest of a dataset that has none, if all are good.
    """

    dataset: DatasetFolder
    write: bool = False

    def run(self) -> None:
        """Print what is wrong, a line for each file."""
        from mereo.synthesis.dataset_contents import check_dataset

        check_dataset(self.dataset, self.write)


@dataclass(frozen=True)
class DatasetShow:
    """Say what a dataset is, from its manifest and the names of its files: object, seed, examples, settings.

    Attributes:
        dataset: folder written by `mereo generate`, or its URL in an object storage.
    """

    dataset: DatasetFolder

    def run(self) -> None:
        """Print a line for each fact."""
        from mereo.cli.dataset import show_dataset

        show_dataset(self.dataset)
