"""How well an object is found in a frame, whole or in part.

    python benchmarks/search.py [OBJECT ...] [--views N] [--seed S] [--conditions NAME ...]
                                [--processes P] [--output FOLDER]

Conditions: `whole`, `screen30` and `screen50` (an occluder with a straight edge hides that share of the object's
pixels), `picture50` (the picture's edge cuts off half), `tool30`, `hand30`, and views by simulated cameras,
`structured-light` and `time-of-flight` at 96 x 96 pixels, `structured-light-192` and `time-of-flight-192` at 192 x 192.
Frames of the first kinds are whole depth images with a mask before a far wall; `whole` and those of cameras are cut
out, so that they do not say what is around the object.

A row: mean IoU / mIoU of the views on a grid of 60 cells, median and greatest seconds, share of views that the fit
explains, and how many of those have an IoU below .8. With `--output` each row is kept in FOLDER/OBJECT-CONDITION.json
as soon as it is measured, and is not measured again. Test seeds begin at 1,000,000: tune on others.
"""

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from occluded_views import Cut, occlude

from mereo.api.objects import Object, load_object
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import TruthGrid, grid_confusion, intersection_over_union, truth_grid
from mereo.geometry.solids import label_grid
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import OBSERVATIONS, GenerateConfig, ObservationName
from mereo.synthesis.examples import sample_view

OBJECTS = ("bunny", "engine", "human", "liver", "lizard", "robot", "rope", "shapes", "sheet", "skull", "tumor")

CUTS: dict[str, tuple[Cut, float]] = {
    "screen30": ("screen", 0.3),
    "screen50": ("screen", 0.5),
    "picture50": ("picture", 0.5),
    "tool30": ("tool", 0.3),
    "hand30": ("hand", 0.3),
}

CAMERAS: dict[str, tuple[ObservationName, int]] = {
    "structured-light": ("structured-light", 96),
    "time-of-flight": ("time-of-flight", 96),
    "structured-light-192": ("structured-light", 192),
    "time-of-flight-192": ("time-of-flight", 192),
}

CONDITIONS = ("whole", *CUTS, *CAMERAS)

WRONG = 0.8
"""IoU below which a frame that is explained was answered wrongly."""

CELLS = 60


@lru_cache(maxsize=1)
def loaded(name: str) -> Object:
    """Object with its shipped weights."""
    return load_object(name)


def frame_of(name: str, condition: str, seed: int, index: int) -> tuple[SensorFrame, SegmentedMesh]:
    """Frame in scene units, and its truth."""
    sensor, size = CAMERAS.get(condition, ("paper", GenerateConfig.image_size))
    settings = GenerateConfig(image_size=size, sensor=OBSERVATIONS[sensor])
    view = sample_view(load_scene(name).for_seed(seed), settings, example_rng(seed, index))
    if condition not in CUTS:
        return SensorFrame(Path("simulated"), view.depth.to_points(), None, "camera", view.depth), view.mesh
    cut = occlude(view, *CUTS[condition], np.random.default_rng([seed, index]), settings)
    return cut.frame(), cut.mesh


def scored(truth: TruthGrid, mesh: SegmentedMesh) -> tuple[float, float]:
    """IoU and mIoU of a mesh."""
    grid = truth.grid
    axes = (grid.origin[axis] + np.arange(grid.labels.shape[axis]) * grid.spacing[axis] for axis in range(3))
    found = intersection_over_union(grid_confusion(truth, label_grid(mesh, *axes), len(mesh.names)))
    return found.iou, found.miou


def measured(name: str, condition: str, seed: int, index: int) -> list[float]:
    """IoU, mIoU, seconds, whether explained, and states alike, of one view."""
    frame, mesh = frame_of(name, condition, seed, index)
    seen = find_object(frame)
    owned = loaded(name)
    registrar = owned.registrar()
    assert registrar is not None
    registrar.prepare()
    started = time.perf_counter()
    answer = answer_frame(seen, owned.network, registrar, scene_unit=1.0)
    fit = answer.registration
    assert fit is not None
    seconds = time.perf_counter() - started
    return [*scored(truth_grid(mesh, CELLS), fit.mesh), seconds, fit.accepted, fit.alike]


def row(name: str, condition: str, seed: int, views: int) -> dict[str, Any]:
    """Measurements of all views."""
    measurements = [measured(name, condition, seed, index) for index in range(views)]
    return {"object": name, "condition": condition, "seed": seed, "views": views, "measured": measurements}


def line(result: dict[str, Any]) -> str:
    """Row of the table."""
    table = np.array(result["measured"], dtype=np.float64)
    iou, miou = table[:, :2].mean(axis=0)
    accepted = table[:, 3] > 0
    wrong = int((accepted & (table[:, 0] < WRONG)).sum())
    cells = (
        *(result["object"], result["condition"], f"{iou:.3f} / {miou:.3f}"),
        *(f"{np.median(table[:, 2]):.1f} ({table[:, 2].max():.1f}) s", f"{accepted.mean():.0%}", wrong),
        f"{table[:, 4].max():.0f}",
    )
    return f"| {' | '.join(map(str, cells))} |"


def work(task: tuple[str, str, int, int, Path | None]) -> dict[str, Any]:
    """One row, from the folder where it is there."""
    name, condition, seed, views, folder = task
    kept = None if folder is None else folder / f"{name}-{condition}.json"
    if kept is not None and kept.is_file():
        result: dict[str, Any] = json.loads(kept.read_text("utf-8"))
        if (result["seed"], result["views"]) != (seed, views) or "measured" not in result:
            raise ValueError(f"{kept} is of other settings: name another --output")
        return result
    result = row(name, condition, seed, views)
    if kept is not None:
        partial = kept.with_suffix(".part")
        partial.write_text(json.dumps(result), encoding="utf-8")
        partial.replace(kept)
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=list(OBJECTS))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--conditions", nargs="+", default=["whole"], choices=CONDITIONS)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    if given.output is not None:
        given.output.mkdir(parents=True, exist_ok=True)
    note = " (test seed)" if given.seed >= TEST_SEED_START else ""
    print(f"{given.views} views of seed {given.seed}{note}\n")
    print("| object | condition | IoU / mIoU | median (most) | explained | of these wrong | alike |")
    print("|---|---|---|---|---|---|---|")
    tasks = [(n, c, given.seed, given.views, given.output) for c in given.conditions for n in given.objects]
    results: list[dict[str, Any]] = []
    with ProcessPoolExecutor(given.processes) as pool:
        for result in pool.map(work, tasks):
            results.append(result)
            print(line(result), flush=True)
    for condition in given.conditions:
        every = [each for result in results if result["condition"] == condition for each in result["measured"]]
        print(line({"object": "mean", "condition": condition, "measured": every}))


if __name__ == "__main__":
    main()
