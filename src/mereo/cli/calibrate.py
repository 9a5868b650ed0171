"""The command ``mereo calibrate``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path

from mereo.cli.options import WeightsName
from mereo.io.bounds import Count, CountOrNone, Threads


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
        from mereo.cli.calibration import calibrate_weights

        calibrate_weights(
            self.weights,
            self.output,
            scene=self.scene,
            views=self.views,
            radius_views=self.radius_views,
            seed=self.seed,
            force=self.force,
        )
