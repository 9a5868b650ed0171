"""Folders of results that `mereo evaluate` leaves on disk."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mereo.evaluation.cases import Evaluation
from mereo.evaluation.scoring import EvaluationConfig, evaluate, trained_scene
from mereo.evaluation.tables import markdown_table, metrics
from mereo.io.atomic_files import new_directory, write_json
from mereo.io.config import CONFIG
from mereo.models.config import EXACT, InferenceConfig
from mereo.models.model import Model
from mereo.models.remote import settings_for
from mereo.models.weights import load_for
from mereo.scenes.registry import files_of
from mereo.scenes.scene import Scene
from mereo.visualization.error_maps import error_picture
from mereo.visualization.evaluation_report import write_evaluation_report
from mereo.workers.spread import Cluster


def evaluate_weights(
    weights: Model | str | Path,
    output: str | Path,
    config: EvaluationConfig,
    *,
    inference: InferenceConfig = EXACT,
    workers: int | Cluster = 1,
    force: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Score weights, write metrics.json, table.md, errors.png, report.html, and print the table: ``mereo evaluate``.

    With ``force`` an existing folder that mereo wrote is replaced; ``options`` are written to config.json.
    Each view is a task of a cluster, where ``workers`` is one.
    """
    scene = config.scene
    read = [*([] if isinstance(weights, Model) else [weights]), *(config.scans or ())]
    with new_directory(output, force, [*read, *(files_of(scene) if isinstance(scene, str) else [])]) as directory:
        model = weights if isinstance(weights, Model) else load_for(weights, settings_for(inference, workers))
        evaluation = evaluate(model, config, progress=True, workers=workers)
        if config.scans is not None:
            facts: dict[str, Any] = {"scans": list(evaluation.examples), "truths": [str(path) for path in config.scans]}
        else:
            facts = {
                "weights": model.name if isinstance(weights, Model) else str(weights),
                "scene": scene.name if isinstance(scene, Scene) else scene or trained_scene(model),
                "seed": config.seed,
                "image_size": config.settings.image_size,
                "noise_std": config.settings.noise_std,
                "sensor": asdict(config.settings.sensor),
                "workspace": config.settings.workspace,
                "device": workers.device if isinstance(workers, Cluster) else model.device.type,
                "precision": model.working_precision,
            }
        write_evaluation(directory, evaluation, {**facts, "trained": model.provenance}, options)
    print(markdown_table(evaluation))
    print(f"wrote {output}")
    return evaluation


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
