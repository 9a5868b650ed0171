"""``mereo calibrate``: weights written anew with what views of training seeds showed of their answers."""

from pathlib import Path

from mereo.evaluation.calibrate import calibrate
from mereo.io.atomic_files import atomic_file
from mereo.models.calibration import calibration_rows
from mereo.models.weights import load_model, with_calibration
from mereo.models.weights_place import find_weights
from mereo.scenes.registry import files_of


def calibrate_weights(
    weights: str, output: Path | None, *, scene: str | None, views: int, radius_views: int, seed: int, force: bool
) -> None:
    """Calibrate weights, write them to ``output`` or, with ``force``, in their own place, and print what was found.

    Raises as ``calibrate`` does, and ``FileExistsError`` for a file that is there, without ``force``.
    """
    path = find_weights(weights)
    place = path if output is None else output
    with atomic_file(place, force=force, inputs=[] if scene is None else files_of(scene)) as partial:
        found = calibrate(load_model(weights), scene, views=views, seed=seed, radius_views=radius_views, quiet=False)
        partial.write_bytes(with_calibration(path, found))
    for title, value in calibration_rows(found):
        print(f"{title:<14} {value}")
    print(f"wrote {place}")
