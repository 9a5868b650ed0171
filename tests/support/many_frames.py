"""Many frames through the command line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticModel
from folder_contents import run_mereo
from two_balls import scene

from mereo.models.config import InferenceConfig


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Weights that the command has loaded; whatever they are called, they are the analytic balls."""
    loaded = []

    def load(weights: str, _: InferenceConfig) -> AnalyticModel:
        loaded.append(weights)
        return replace(scene("camera")[1], provenance={})

    monkeypatch.setattr("mereo.models.weights.load_for", load)
    return loaded


def frames(folder: Path, *names: str) -> Path:
    """Folder of clouds of these names, all of the two balls."""
    folder.mkdir(parents=True)
    for name in names:
        np.save(folder / name, scene("camera")[0])
    return folder


def run(*arguments: str | Path) -> int:
    return run_mereo("reconstruct", *arguments, "--weights", "any", "--resolution", "12")


def content(folder: Path) -> dict[str, bytes]:
    """What of a result no clock decides."""
    timed = (".mereo.json", "summary.json", "report.html")
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name not in timed}
