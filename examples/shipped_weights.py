"""Every object with shipped weights in one picture: a test view, its reconstruction, what is wrong in it, the truth.

    python examples/shipped_weights.py --output objects.png

The view is the first of the test seed 1,000,000, the same for everyone; none of it was ever trained on.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.models.weights import load_model
from mereo.models.weights_place import shipped_names
from mereo.scenes.scene import AssetUnavailable
from mereo_learning.cases import EvaluatedView
from mereo_learning.error_maps import error_picture
from mereo_learning.scoring import EvaluationConfig, evaluate


def first_view(name: str, cells: int) -> EvaluatedView:
    """The first test view with its labels, true and predicted; the row says how good this one is."""
    evaluation = evaluate(load_model(name), EvaluationConfig(examples=1, cells=cells))
    scores = evaluation.scores
    return replace(evaluation.views[0], name=f"{name}\nIoU {scores.iou:.2f}\nmIoU {scores.miou:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw one test view of every object with shipped weights.")
    parser.add_argument("--output", type=Path, default=Path("objects.png"), help="the PNG to write")
    parser.add_argument("--weights", nargs="*", default=shipped_names(), help="names of shipped weights; default all")
    parser.add_argument("--cells", type=int, default=100, help="grid cells along each axis")
    parser.add_argument("--force", action="store_true", help="replace the file where it exists")
    options = parser.parse_args()
    try:
        check_file_place(options.output, force=options.force)
    except (OSError, ValueError) as error:
        parser.error(str(error))

    views: list[EvaluatedView] = []
    for name in options.weights:
        try:
            views.append(first_view(name, options.cells))
        except AssetUnavailable as error:
            print(f"{name} is left out: {error}")
    with atomic_file(options.output, force=options.force) as partial:
        error_picture(partial, views)
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()
