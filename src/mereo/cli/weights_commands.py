"""The commands ``mereo weights ...``: list and show. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass

from mereo.cli.options import WeightsFiles, WeightsName


@dataclass(frozen=True)
class WeightsList:
    """Name the shipped weights, each with its object, size and scores.

    Attributes:
        weights: files, or folders of them, to list instead of the shipped ones.
    """

    weights: WeightsFiles = ()

    def run(self) -> None:
        """Print a row for each file of weights."""
        from mereo.cli.weights import list_weights

        list_weights(self.weights)


@dataclass(frozen=True)
class WeightsShow:
    """Say what weights know: object, segments, unit, network, statistical model, training, scores and limits.

    Attributes:
        weights: a shipped name or a file.
        json: print everything as JSON, recipe and settings included.
    """

    weights: WeightsName
    json: bool = False

    def run(self) -> None:
        """Print what the file and its card say."""
        from mereo.cli.weights import show_weights

        show_weights(self.weights, self.json)
