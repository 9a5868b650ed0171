"""Scores on real scans (paper, section 4.3): the four of the bunny, or those with a truth from ``mereo align``."""

from collections.abc import Sequence
from pathlib import Path

from mereo.evaluation.ground_truth import truth_grid
from mereo.evaluation.registration.truth_file import read_truth
from mereo.evaluation.scans import SCANS, PosedScan, bunny_posed
from mereo.evaluation.scoring import CELLS, Evaluation, TestCase, check_names, score_cases
from mereo.models.model import Model


def evaluate_scans(model: Model, *, truths: Sequence[str | Path] = (), cells: int = CELLS) -> Evaluation:
    """Scores of a model on real scans.

    Args:
        model: the trained model.
        truths: truth files, or their folders, of ``mereo align``; none means the four scans of the bunny.
        cells: cells of the grid along each axis.

    Raises ``ValueError`` for another object's model or two scans of one name, ``FileNotFoundError`` for a missing file,
    and ``AssetUnavailable`` where a scan of the bunny cannot be had.
    """
    scans = [read_truth(path) for path in truths] if truths else [bunny_posed(name) for name in SCANS]
    names = [scan.name for scan in scans]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"two truths are called {repeated[0]!r}; results are listed by name: rename one of the folders"
        )
    for scan in scans:
        check_names(model, scan.truth.names)
    return score_cases(model, lambda index: _case(scans[index], cells), len(scans), progress=False)


def _case(scan: PosedScan, cells: int) -> TestCase:
    cloud, truth, _ = scan.in_camera()
    return TestCase(scan.name, cloud, truth_grid(truth, cells))
