"""Golden answers: what the product said of frames that are made anew, and whether a working tree still says it.

    python tests/support/golden_answers.py [OBJECT ...] [--write] [--processes 2]

prints for each frame whether the answer is the same to the last bit, near, or another one, then the mean scores, and
exits with 1 where any is another one. With --write it keeps the answers in ``golden/``. On the processor that kept them
answers are the same; on others clean views are near, and noisy ones, whose fits decide between nearly equal states, are
others of the same mean scores (``test_golden``).

With --last-bits it answers the ``FIRM`` frames of the objects again, as they are and with their points moved by less
than a float32 shows, and keeps the largest change of each number that it has seen, beside what was kept before:

    for kind in libraries older avx2 sse; do
        .ci/processors $kind -- .venv/bin/python tests/support/golden_answers.py --last-bits
    done

The frames: four views of each object with shipped weights, of training seed 1000, by three cameras; the four scans of
the bunny; and the same views of two objects of one's own (``golden_objects``). Views 0 and 1 state the unit where the
object has one, views 2 and 3 do not.
"""

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from folder_contents import read_json
from golden_objects import FOLDER, OWN, weights_of
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng

import mereo
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.io.atomic_files import JsonObject
from mereo.models.weights_place import shipped_names
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.scans import SCANS, bunny_posed

SEED, VIEWS = 1000, 4
CAMERAS = ("paper", "structured-light", "time-of-flight")
OBJECTS = (*shipped_names(), *OWN, "scans")
RESOLUTION, CELLS, POSITIONS = 48, 60, 64

NEAR_SIZE, NEAR_SHARE = 0.002, 0.01
"""How far positions may differ, as a share of the object's size, and how far scores and shares, where that was not
measured."""

FIRM = {"pliers": "paper 0", "lump": "paper 2", "liver": "paper 1"}
"""Views that are answered in a second or two, on every processor alike, and for which it is kept how far last bits move
each number (``last_bits``)."""

TRIALS, LAST_BIT, BEYOND = 12, 1e-7, 2.0
"""Trials with moved points, by how much of a coordinate, and how many times the largest change of all trials on all
paths is allowed: the next processor may go farther than the few that were tried."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Points that are answered, with their truth; ``unit_m`` is None where the answer has to find it."""

    points: ndarray
    truth: SegmentedMesh
    axes: str = "camera"
    unit_m: float | None = None


def frames_of(name: str) -> Iterator[tuple[str, Frame]]:
    if name == "scans":
        for scan in SCANS:
            posed = bunny_posed(scan)
            yield scan, Frame(posed.cloud.points, posed.truth, posed.frame, 1.0)
        return
    scene = scene_of(name)
    for camera in CAMERAS:
        for index in range(VIEWS):
            view = sample_view(scene.for_seed(SEED), GenerateConfig(sensor=SENSORS[camera]), example_rng(SEED, index))
            points = view.depth.to_points().points
            yield f"{camera} {index}", Frame(points, view.mesh, unit_m=scene.unit_m if index < 2 else None)


@cache
def scene_of(name: str) -> Scene:
    """Scene of an object; its own files are written anew."""
    if name not in OWN:
        return mereo.load_scene(name)
    return mereo.load_scene(str(OWN[name](Path(tempfile.mkdtemp(prefix="golden-")))))


@cache
def object_of(name: str) -> mereo.Object:
    weights = weights_of(name) if name in OWN else "bunny" if name == "scans" else name
    scene = scene_of(name) if name in OWN else None
    return mereo.load_object(weights, scene, device="cpu", precision="float32")


def facts_of(name: str, frame: Frame) -> JsonObject:
    found = mereo.reconstruct(
        frame.points, object_of(name), resolution=RESOLUTION, axes=frame.axes, unit_m=frame.unit_m
    )
    surfaces, registration = found.reconstruction.surfaces, found.registration
    grid = truth_grid(frame.truth, CELLS)
    labels = labels_on(surfaces, grid.grid)
    model = object_of(name).network
    assert model is not None
    scores = intersection_over_union(grid_confusion(grid, labels, len(model.names)), model.segmented)
    facts = {
        "answer": "network" if registration is None else registration.method,
        "iou": round(scores.iou, 4),
        "miou": round(scores.miou, 4),
        "known": found.recognition.known,
        "recognition": found.recognition.description,
        "confidence": [round(float(segment.confidence), 3) for segment in found.reconstruction.segments],
        "surfaces": digest(*(segment.vertices for segment in surfaces.segments)),
    }
    if registration is None:
        return facts
    material, sure = registration.material, registration.uncertainty
    rows = np.linspace(0, len(material) - 1, POSITIONS).astype(int)
    assert sure is not None
    return facts | {
        "explained": round(registration.explained, 4),
        "believed": registration.accepted,
        "ruled_out": round(registration.ruled_out or 0.0, 4),
        "scene_unit": significant(registration.scene_unit),
        "unit_known": registration.unit_known,
        "radius95": [significant(value) for value in np.quantile(np.concatenate(sure.vertices), (0.5, 0.95))],
        "size": significant(float(np.ptp(material, axis=0).max())),
        "positions": [[significant(value) for value in row] for row in material[rows]],
        "material": digest(material),
    }


def significant(value: float) -> float:
    return float(f"{value:.6g}")


def digest(*arrays: ndarray) -> str:
    """Short digest of the exact values."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:12]


Answers = dict[str, JsonObject]
"""Facts of the answers to an object's frames, by the frames' names."""


def answers_of(name: str) -> Answers:
    import torch

    torch.set_num_threads(1)
    return {frame: facts_of(name, given) for frame, given in frames_of(name)}


# --- comparison -------------------------------------------------------------------------------------------------------


def change(fact: str, kept: JsonObject, now: JsonObject) -> float:
    """How far a number is from the kept one: relative for lengths and radii, in object sizes for positions."""
    if fact == "positions":
        return float(norm(np.asarray(now[fact]) - kept[fact], axis=1).max() / kept["size"])
    before, after = (np.asarray(facts.get(fact) or 0.0, float) for facts in (kept, now))
    return float((abs(after - before) / (abs(before) if fact in ("scene_unit", "radius95") else 1.0)).max())


NEAR = {
    **dict.fromkeys(("iou", "miou", "explained", "ruled_out", "scene_unit", "confidence", "radius95"), NEAR_SHARE),
    "positions": NEAR_SIZE,
}
"""Numbers that are compared, and how far they may be off where nothing was measured."""

ROUNDING = 1e-3
"""What every number may differ by: scores are kept with four digits, shares are of a few hundred points."""


def difference(kept: JsonObject, now: JsonObject) -> str | None:
    """How an answer differs from the kept one beyond the precision of other processors; None where it does not."""
    for fact in ("answer", "known", "believed", "unit_known"):
        if kept.get(fact) != now.get(fact):
            return f"{fact} was {kept.get(fact)}, is {now.get(fact)}"
    measured = kept.get("last_bits", {})
    for fact in NEAR.keys() & kept.keys():
        most = BEYOND * measured[fact] + ROUNDING if fact in measured else NEAR[fact]
        if (off := change(fact, kept, now)) > most:
            return f"{fact} is off by {off:.2%}, more than {most:.2%}: it was {kept[fact]}, is {now.get(fact)}"
    return None


def last_bits_of(name: str, trials: int = TRIALS) -> dict[str, float]:
    """Largest change of each number of an object's firm answer in some trials, and in those that were kept."""
    (frame,) = (frame for frame_name, frame in frames_of(name) if frame_name == FIRM[name])
    kept = kept_of(name)[FIRM[name]]
    rng = default_rng()
    most = dict.fromkeys(NEAR, 0.0) | kept.get("last_bits", {})
    for trial in range(trials):
        moved = frame.points * (1.0 + min(trial, 1) * LAST_BIT * rng.standard_normal(frame.points.shape))
        now = facts_of(name, replace(frame, points=moved))
        for fact in NEAR:
            most[fact] = max(most[fact], round(change(fact, kept, now), 6))
        print(name, difference({**kept, "last_bits": most}, now) or "as firm as it was", most, flush=True)
    return most


def mean_score(answers: Answers, score: str) -> float:
    return float(np.mean([facts[score] for facts in answers.values()]))


def is_same(kept: JsonObject, now: JsonObject) -> bool:
    return all(kept.get(fact) == now.get(fact) for fact in ("surfaces", "material"))


def kept_of(name: str) -> Answers:
    return read_json(FOLDER / f"{name}.json")


def write(name: str, answers: Answers) -> None:
    lines = ",\n".join(f"{json.dumps(frame)}: {json.dumps(facts)}" for frame, facts in answers.items())
    (FOLDER / f"{name}.json").write_text(f"{{\n{lines}\n}}\n", "utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", help="by default all")
    parser.add_argument("--write", action="store_true", help="keep these answers")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--last-bits", action="store_true", help="measure how far last bits move the firm answers")
    options = parser.parse_args()
    names = options.objects or OBJECTS
    if options.last_bits:
        for name in options.objects or FIRM:
            write(name, {**kept_of(name), FIRM[name]: {**kept_of(name)[FIRM[name]], "last_bits": last_bits_of(name)}})
        return 0
    counts = {"same": 0, "near": 0, "another": 0}
    with ProcessPoolExecutor(options.processes, get_context("spawn")) as pool:
        for name, answers in zip(names, pool.map(partial(answers_of), names), strict=True):
            if options.write:
                write(name, answers)
                print(f"{name}: {len(answers)} answers kept", flush=True)
                continue
            kept = kept_of(name)
            for frame, now in answers.items():
                why = difference(kept[frame], now)
                verdict = "another" if why else "same" if is_same(kept[frame], now) else "near"
                counts[verdict] += 1
                print(f"{name:8} {frame:20} {verdict}{': ' + why if why else ''}", flush=True)
            for score in ("iou", "miou"):
                before, after = mean_score(kept, score), mean_score(answers, score)
                print(f"{name:8} mean {score:15} {before:.4f} -> {after:.4f}", flush=True)
    if not options.write:
        print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    return 1 if counts["another"] else 0


if __name__ == "__main__":
    sys.exit(main())
