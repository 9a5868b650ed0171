"""Scores on real scans (paper, section 4.3): the four of the bunny, or those with a truth from ``mereo align``."""

from collections.abc import Sequence
from pathlib import Path

from mereo.evaluation.registration.truth_file import read_truth
from mereo.evaluation.sample_views import truth_grid
from mereo.evaluation.scans import SCANS, PosedScan, bunny_posed
from mereo.evaluation.scoring import CELLS, Evaluation, TestCase, check_names, score_cases, write_evaluation
from mereo.io.atomic_files import new_directory
from mereo.models.model import Model


def evaluate_scans(
    model: Model, output: str | Path | None = None, *, truths: Sequence[str | Path] = (), cells: int = CELLS
) -> Evaluation:
    """Scores on real scans; writes what ``evaluate_weights`` does when ``output`` is given.

    Args:
        model: the trained model.
        output: folder to create.
        truths: truth files, or their folders, of ``mereo align``; none means the four scans of the bunny.
        cells: of the grid along each axis.

    Raises ``ValueError`` for another object's model or two scans of one name, ``FileNotFoundError`` for a missing file,
    and ``assets.AssetUnavailable`` where a scan of the bunny cannot be had.
    """
    scans = [read_truth(path) for path in truths] if truths else [bunny_posed(name) for name in SCANS]
    names = [scan.name for scan in scans]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"two truths are called {repeated[0]!r}; results are listed by name: rename one of the folders"
        )
    for scan in scans:
        check_names(model, scan.truth.names)
    evaluation = score_cases(model, lambda index: _case(scans[index], cells), len(scans), progress=False)
    if output is not None:
        with new_directory(output) as directory:
            facts = {"scans": names, "truths": [str(path) for path in truths], "trained": model.provenance}
            write_evaluation(directory, evaluation, facts)
    return evaluation


def _case(scan: PosedScan, cells: int) -> TestCase:
    cloud, truth, _ = scan.in_camera()
    return TestCase(scan.name, cloud, truth_grid(truth, cells))
