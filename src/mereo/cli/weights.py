"""The commands of weights: list, show, calibrate, release."""

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mereo.cli.options import Outcome, Paths, WeightsFiles, WeightsName
from mereo.io.bounds import Count, CountOrNone, Threads

SCORES = re.compile(r"^\| ([\d.-]+) \| ([\d.-]+) \|", re.MULTILINE)
"""IoU and mIoU in a row of a model card."""


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

        from mereo.models.weights_place import NOT_SHIPPED, read_facts, shipped_names

        names = [file for place in self.weights for file in _weights_in(place)] or shipped_names()
        if not names:
            print(f"no weights are shipped here: {NOT_SHIPPED}")
            return
        table = Table()
        for column in ("name", "object", "segments", "size", "IoU mIoU"):
            table.add_column(column, overflow="fold")
        for name in names:
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
        content = path.read_bytes()
        card = path.with_suffix(".md")
        digest = sha256(content).hexdigest()
        frame = SourceFrame.of_facts((header.get("states") or {}).get("frame"))
        unit_m = None if frame is None else frame.unit_m
        if card.is_file():
            text = card.read_text("utf-8")
        else:
            from mereo.models.weights import load_model
            from mereo_learning.model_card import card as card_of

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

    files = []
    for file in sorted(place.rglob("*.safetensors")):
        with suppress(ValueError):
            read_facts(file)
            files.append(file)
    if not files:
        raise ValueError(f"{place} holds no weights; name a .safetensors file of mereo train, or a folder of such")
    return files


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
        """Measure, write the weights again, and print the result."""
        from mereo.io.atomic_files import atomic_file
        from mereo.models.calibration import calibration_rows
        from mereo.models.weights import load_model, with_calibration
        from mereo.models.weights_place import find_weights
        from mereo.scenes.registry import files_of
        from mereo_learning.calibrate import calibrate

        path = find_weights(self.weights)
        output = self.output or path
        with atomic_file(output, force=self.force, inputs=files_of(self.scene) if self.scene else []) as partial:
            calibration = calibrate(
                load_model(self.weights),
                self.scene,
                views=self.views,
                seed=self.seed,
                radius_views=self.radius_views,
                quiet=False,
            )
            partial.write_bytes(with_calibration(path, calibration))
        for title, value in calibration_rows(calibration):
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
    tests: Paths = ()
    force: bool = False

    def run(self) -> None:
        """Write the weights to hand on, and their model card."""
        from mereo_learning.model_card import release

        release(self.weights, self.name, self.output, self.tests, self.force)
