"""``mereo release``: see ``commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Release:
    """Write weights to hand on: in float16, with a model card of what they know, how they were trained and tested.

    Attributes:
        weights: a shipped name or a file.
        name: of the files: lower case letters, digits, - and _.
        output: folder to create.
        tests: folders that `mereo evaluate` has written for these weights; their scores go into the card.
        force: replace an existing output folder.
    """

    weights: Positional[str]
    name: str
    output: Path
    tests: tuple[Path, ...] = ()
    force: bool = False

    def run(self) -> None:
        from mereo.training.model_card import release

        release(self.weights, self.name, self.output, self.tests, self.force)
