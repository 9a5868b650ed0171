"""The commands of weights: list, show, push and pull, calibrate, release."""

from dataclasses import dataclass
from pathlib import Path

from mereo.cli.options import RepositoryName, WeightsFiles, WeightsName
from mereo.io.bounds import Count, CountOrNone, Threads


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
