"""Scores on real scans (paper, section 4.3): the four of the bunny, or those with a truth from ``mereo align``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mereo.evaluation.cases import TestCase
from mereo.evaluation.ground_truth import truth_grid
from mereo.evaluation.registration.truth_file import read_truth
from mereo.evaluation.results import Evaluation
from mereo.evaluation.scans import SCANS, PosedScan, bunny_posed
from mereo.evaluation.scoring import CELLS, check_names, score_cases
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.register import registrar_for
from mereo.models.model import Model
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel


def evaluate_scans(
    model: Model,
    *,
    truths: Sequence[str | Path] = (),
    scene: Scene | None = None,
    cells: int = CELLS,
    method: AnswerMethod = "auto",
) -> Evaluation:
    """Scores of a model on real scans.

    Args:
        model: the trained model.
        truths: truth files, or their folders, of ``mereo align``; none means the four scans of the bunny.
        scene: the scene that the scans were aligned with; by default each truth file's own, which must be built in or
            YAML: a data file never has a Python scene run.
        cells: cells of the grid along each axis.
        method: which answer is scored: by default what a user gets, and beside it all others that can be had.

    Raises ``ValueError`` for another object's model, two scans of one name and a scene without truths,
    ``FileNotFoundError`` for a missing file, and ``AssetUnavailable`` where a scan of the bunny cannot be had.
    """
    if scene is not None and not truths:
        raise ValueError(
            f"the scene {scene.name!r} is given without truth files; the bunny's own scans have their scene: name "
            "truth files with --scans, or leave out --scene"
        )
    scans = [read_truth(path, scene) for path in truths] if truths else [bunny_posed(name) for name in SCANS]
    names = [scan.name for scan in scans]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"two truths are called {repeated[0]!r}; results are listed by name: rename one of the folders"
        )
    for scan in scans:
        check_names(model, scan.truth.names)
    registrar = registrar_for(model, method, scene)
    # every scan keeps its labels: there are few, and the paper shows all of its own (appendix D)
    return score_cases(model, lambda index: _case(scans[index], cells), len(scans), True, registrar, kept=len(scans))


def _case(scan: PosedScan, cells: int) -> TestCase:
    cloud, truth, _ = scan.in_camera()
    vertices = np.concatenate([segment.vertices for segment in truth.segments])

    def material(model: StatisticalModel) -> Float[np.ndarray, "m 3"]:
        """The vertices, which come first among the material points of a model of the same meshes."""
        return vertices if sum(model.vertex_counts) == len(vertices) else np.empty((0, 3))

    return TestCase(scan.name, cloud, truth_grid(truth, cells), scan.scene_unit, material)
