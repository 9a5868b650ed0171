"""Steps from an object to weights as functions: what the commands of the same names do, with what they leave returned.

    dataset -train-> weights -evaluate-> Evaluation
                        '-----export---> graphs for other runtimes
    scene or meshes -learn-> all of it where the object needs it, in so many minutes

They print their progress as the commands do, and raise the sentences that those print.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mereo.api.words import python_words, with_changes
from mereo.fitting.config import AnswerMethod
from mereo.geometry.conventions import LengthUnit
from mereo.geometry.metrics import format_score
from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import Positive, check_value
from mereo.io.errors import checked_path
from mereo.io.object_storage import ObjectPath, place_of
from mereo.models.config import EXACT, Device, ExportFormat, InferenceConfig
from mereo.models.export.onnx_export import export_weights
from mereo.models.model import Model
from mereo.models.weights import load_for, settings_for
from mereo.models.weights_place import WEIGHTS
from mereo.workers.spread import choose_cluster
from mereo_learning import learn as learning
from mereo_learning import scoring, trainer
from mereo_learning.cases import Evaluation
from mereo_learning.config import PRESETS, PresetName, TrainConfig
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.scoring import EvaluationConfig
from mereo_learning.search_stage import TrainChoice


def train(
    dataset: str | Path | ObjectPath,
    output: str | Path,
    config: TrainConfig | PresetName = "base",
    *,
    device: Device = "auto",
    **changes: Any,
) -> Path:
    """File of weights, trained on generated examples; the same call again continues a stopped run: `mereo train`.

    Args:
        dataset: folder written by ``generate``, or its URL.
        output: folder of the run: config.json, metrics.csv, curves.png, checkpoint.safetensors, weights.safetensors.
        config: the recipe, or the name of a preset.
        device: where the network is trained; "auto" takes a CUDA device where there is one.
        changes: fields of ``TrainConfig`` to be changed in it, such as ``init="bunny"`` or ``epochs=20.0``.

    Raises ``TypeError`` for a field that there is none of, ``ValueError`` for a preset that is unknown and values that
    are refused, and as ``mereo_learning.trainer.train`` does.
    """
    if isinstance(config, str):
        if config not in PRESETS:
            raise ValueError(f"the preset is {config!r}; it must be one of {', '.join(PRESETS)}: correct the spelling")
        config = PRESETS[config]
    with python_words():
        return trainer.train(place_of(dataset), Path(output), with_changes(config, changes), device=device)


def evaluate(
    model: Model | str | Path,
    config: EvaluationConfig = EvaluationConfig(),  # noqa: B008 (frozen)
    *,
    output: str | Path | None = None,
    inference: InferenceConfig = EXACT,
    progress: bool = True,
    ray: str | None = None,
    overwrite: bool = False,
    **changes: Any,
) -> Evaluation:
    """Scores of weights on test examples of their scene, or on real scans: `mereo evaluate`.

    Args:
        model: the weights, or their shipped name or file.
        config: what they are scored on, and whose answer is scored.
        output: folder to create with metrics.json, table.md, errors.png and report.html; None writes nothing.
        inference: where and how exactly the network computes, for weights that are loaded here.
        progress: show the time left, where nothing is written.
        ray: score each view in a task of one CPU of a Ray cluster, as in ``generate``; "local" has one for each core.
        overwrite: replace an output folder that mereo wrote, and nothing else is in.
        changes: fields of ``EvaluationConfig`` to be changed in it, such as ``scene="mine.yaml"`` or ``examples=16``.

    Raises ``ValueError`` for a training seed, no examples, another object than the model's, and a simulated camera for
    scans, which are real; ``FileExistsError`` for an output with content; ``TypeError`` for an unknown field.
    """
    changes = {name: str(value) if isinstance(value, Path) else value for name, value in changes.items()}
    with python_words():
        config = with_changes(config, changes)
        workers = choose_cluster(ray) or 1
        if output is not None:
            return evaluate_weights(model, output, config, inference=inference, workers=workers, force=overwrite)
        loaded = model if isinstance(model, Model) else load_for(model, settings_for(inference, workers))
        return scoring.evaluate(loaded, config, progress=progress, workers=workers)


@python_words()
def export(
    model: Model | str | Path, output: str | Path, format: ExportFormat = "onnx", overwrite: bool = False
) -> Path:
    """Folder with a network as two graphs, encoder and query, for other runtimes: `mereo export`.

    Args:
        model: the weights, or their shipped name or file.
        output: folder to create; for ONNX with mereo_onnx.py, which runs the graphs with numpy and onnxruntime alone.
        format: "onnx", or "torch" for .pt2 files.
        overwrite: replace an existing folder that mereo wrote, and nothing else is in.

    Raises ``ValueError`` for an autodecoder, ``ImportError`` without the extra `onnx`, ``FileExistsError`` for a folder
    with content unless ``overwrite``.
    """
    check_value("format", format, ExportFormat, "onnx")
    export_weights(model, output, format, overwrite)
    return Path(output)


@dataclass(frozen=True)
class Learned:
    """Outcome of ``learn``: a folder that ``load_object`` takes, with weights where the object was trained.

    Attributes:
        folder: the folder.
        weights: file of the weights, for ``load_model``; None where nothing was trained.
        scene: name or file of the object's scene.
        frame: point cloud to try it on.
        report: page of the scores; None where nothing was trained.
        method: whose answers are best, as ``reconstruct`` takes it: "auto" or "search".
        metrics: scores of each of these on the same test views, as metrics.json in the folder has them.
    """

    folder: Path
    weights: Path | None
    scene: str
    frame: Path
    report: Path | None
    method: AnswerMethod
    metrics: JsonObject

    @property
    def iou(self) -> float:
        """IoU of the answers by ``method``, on views that training has not seen."""
        return float(self.metrics["iou"])

    @property
    def miou(self) -> float | None:
        """Mean IoU of the segments; None where the weights tell no segments apart."""
        value = self.metrics["miou"]
        return None if value is None else float(value)

    def __repr__(self) -> str:
        miou = "" if self.miou is None else f", mIoU {format_score(self.miou)}"
        trained = "trained" if self.weights is not None else "not trained"
        return f"Learned({str(self.folder)!r}: {trained}, method {self.method}, IoU {format_score(self.iou)}{miou})"


@python_words()
def learn(
    object: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    minutes: float = 10.0,
    init: str = "",
    units: LengthUnit | None = None,
    workers: int = 1,
    train: TrainChoice = "auto",
) -> Learned:
    """Score the search alone on an object, and train a network of it where that is not good enough: `mereo learn`.

    Args:
        object: a scene's name or file, or the object's meshes: one for each segment, one file of named parts, or a
            label volume.
        output: folder to create; the same call continues one that was stopped.
        minutes: what all stages may take together.
        init: weights to start from, a shipped name or a file; by default the shipped ones that adapt fastest.
        units: of the meshes; guessed where not given.
        workers: processes that make examples, as in ``generate``; 0 means one per core.
        train: "auto" where the search alone is not good enough, "always", or "never".

    Raises ``ValueError`` for other arguments than the folder was begun with, and as the stages do.
    """
    given = object if isinstance(object, Iterable) and not isinstance(object, str) else [object]
    files = [checked_path(file, "object") for file in given]
    folder = checked_path(output, "output")
    check_value("train", train, TrainChoice, "auto")
    check_value("minutes", minutes, Positive, 10.0)
    if units is not None:
        check_value("units", units, LengthUnit, "mm")
    processes = workers or os.cpu_count() or 1
    metrics = learning.learn(files, folder, learning.LearnConfig(minutes, init, units, processes, train))
    return Learned(
        folder=folder,
        weights=folder / WEIGHTS if metrics["trained"] else None,
        scene=learning.scene_for(files, folder, units),
        frame=folder / learning.FRAME,
        report=folder / learning.TEST / "report.html" if metrics["trained"] else None,
        method=metrics["method"],
        metrics=metrics,
    )
