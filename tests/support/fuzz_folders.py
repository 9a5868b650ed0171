"""Small valid folders that mereo writes and reads again, for the tests that damage a file of them: ``write(path)``."""

from pathlib import Path

import numpy as np
from fuzz_files import POINTS, bar, dataset, scene_file, tiny_model

from mereo.io.atomic_files import check_new_directory, new_directory, write_json
from mereo_learning.config import PRESETS
from mereo_learning.dataset import Dataset
from mereo_learning.model_card import card
from mereo_learning.placement import PlacedSegment, Placement
from mereo_learning.processes import Process
from mereo_learning.run_directory import claim_run, fit_config
from mereo_learning.scans import ScanFile, read_truth, write_truth
from mereo_learning.tables import read_metrics


def result(path: Path) -> None:
    """Its list of files, which is what is damaged."""
    with new_directory(path.parent) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a.txt").write_text("a")
        (folder / "b.txt").write_text("b")


def replaced(path: Path) -> object:
    return check_new_directory(path.parent, force=True)


def run(path: Path) -> None:
    (path.parent / ".data").mkdir()
    dataset(path.parent / ".data" / "any")
    claimed(path)


def claimed(path: Path) -> None:
    data = Dataset.load(path.parent / ".data")
    claim_run(path.parent, fit_config(PRESETS["tiny"], data), data, Process())


def scores(path: Path) -> None:
    names, pair = tiny_model().names, {"iou": 0.5, "miou": 0.25}
    answers = {name: {**pair, "seconds": 1.5} for name in ("network", "modes")}
    facts = {"weights": "w", "examples": 2, "seed": 1_000_000, "noise_std": 0.1}
    write_json(path, {**facts, **pair, "per_segment": dict.fromkeys(names, 0.5), "example_mean": pair, **answers})


def scored(path: Path) -> object:
    return card("toy", tiny_model(), [read_metrics(path)], b"")


def truth(path: Path) -> None:
    scene_file(path.with_name("bar.yaml"))
    np.save(path.with_name("scan.npy"), POINTS)
    rest = bar().rest
    placed = tuple(PlacedSegment(name, np.eye(4), "scan", 9, 0.1, 0.1, 0.1, 0.0, 0.0, 6) for name in rest.names)
    write_truth(
        path.parent, path.parent, ScanFile(path.with_name("scan.npy"), "mm"), str(path.with_name("bar.yaml")), rest,
        Placement(placed, rest, 0.9, 1.0), "object",
    )  # fmt: skip


def placed(path: Path) -> object:
    return read_truth(path)
