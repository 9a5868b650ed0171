"""Folders of results that `mereo evaluate` leaves on disk."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mereo.evaluation.cases import Evaluation
from mereo.evaluation.scoring import CELLS, evaluate, evaluate_scans, trained_scene
from mereo.evaluation.tables import markdown_table, metrics
from mereo.fitting.config import AnswerMethod
from mereo.io.atomic_files import write_json
from mereo.io.config import CONFIG
from mereo.io.output_folders import new_directory
from mereo.models.config import EXACT, InferenceConfig
from mereo.models.elsewhere import for_tasks
from mereo.models.model import Model
from mereo.models.weights import load_for
from mereo.scenes.registry import files_of, load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig
from mereo.visualization.error_maps import error_picture
from mereo.visualization.evaluation_report import write_evaluation_report
from mereo.workers.config import Cluster


def evaluate_weights(
    weights: Model | str | Path,
    output: str | Path,
    *,
    examples: int = 128,
    seed: int = TEST_SEED_START,
    scene: Scene | str | None = None,
    cells: int = CELLS,
    settings: GenerateConfig | None = None,
    inference: InferenceConfig = EXACT,
    method: AnswerMethod = "auto",
    force: bool = False,
    options: Mapping[str, Any] | None = None,
    cluster: Cluster | None = None,
) -> Evaluation:
    """Score weights, write metrics.json, table.md, errors.png, report.html, and print the table: ``mereo evaluate``.

    With ``force`` an existing folder that mereo wrote is replaced; ``options`` are written to config.json.
    Each view is a task of ``cluster``, where one is given.
    """
    read = [*([] if isinstance(weights, Model) else [weights]), *_files_of(scene)]
    with new_directory(output, force, read) as directory:
        model = weights if isinstance(weights, Model) else load_for(weights, for_tasks(inference, cluster))
        settings = settings or GenerateConfig()
        evaluation = evaluate(
            model,
            scene,
            examples=examples,
            seed=seed,
            cells=cells,
            progress=True,
            settings=settings,
            method=method,
            cluster=cluster,
        )
        facts = {
            "weights": model.name if isinstance(weights, Model) else str(weights),
            "scene": scene.name if isinstance(scene, Scene) else scene or trained_scene(model),
            "seed": seed,
            "image_size": settings.image_size,
            "noise_std": settings.noise_std,
            "sensor": asdict(settings.sensor),
            "workspace": settings.workspace,
            "device": cluster.device if cluster else model.device.type,
            "precision": model.working_precision,
            "trained": model.provenance,
        }
        write_evaluation(directory, evaluation, facts, options)
    print(markdown_table(evaluation))
    print(f"wrote {output}")
    return evaluation


def evaluate_on_scans(
    model: Model,
    output: str | Path,
    *,
    truths: Sequence[str | Path] = (),
    scene: Scene | str | None = None,
    cells: int = CELLS,
    method: AnswerMethod = "auto",
    force: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Score a model on real scans, with the same files as ``evaluate_weights``: ``mereo evaluate --scans``.

    Takes the arguments of ``evaluate_scans``; ``scene`` may be a name or a file; the others are as there.
    """
    with new_directory(output, force, [*truths, *_files_of(scene)]) as directory:
        loaded = load_scene(scene) if isinstance(scene, str) else scene
        evaluation = evaluate_scans(model, truths=truths, scene=loaded, cells=cells, method=method)
        facts = {"scans": list(evaluation.examples), "truths": [str(path) for path in truths]}
        write_evaluation(directory, evaluation, {**facts, "trained": model.provenance}, options)
    print(markdown_table(evaluation))
    return evaluation


def _files_of(scene: Scene | str | None) -> list[Path]:
    """Files that a named scene is read from."""
    return files_of(scene) if isinstance(scene, str) else []


def write_evaluation(
    directory: Path, evaluation: Evaluation, facts: dict[str, Any], options: Mapping[str, Any] | None = None
) -> None:
    """Write metrics.json, table.md, errors.png and report.html; ``facts`` come first in the JSON.

    Also config.json of ``options``, where there are any.
    """
    if options is not None:
        write_json(directory / CONFIG, options)
    found = metrics(evaluation, facts)
    write_json(directory / "metrics.json", found)
    (directory / "table.md").write_text(markdown_table(evaluation), encoding="utf-8")
    error_picture(directory / "errors.png", evaluation.views)
    write_evaluation_report(directory / "report.html", found, evaluation.views[0].colors, directory / "errors.png")
