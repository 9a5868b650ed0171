"""Bank of hypotheses: every candidate that a fit makes of many frames, with its terms and its true error.

    python benchmarks/bank.py FOLDER [--objects NAME ...] [--conditions NAME ...] [--views N] [--processes P]

Frames are those of `bank_views` (training seeds): N of each object in each condition, and one of each kind of other
thing. Each is answered by `answer_frame` without a network, and everything that is scored on the way is kept in
FOLDER/OBJECT/CONDITION-NUMBER.npz, with what the frame's own truth gives as a start and with the answer. Frames that
are there already are not made again, so that a run that was cut off goes on where it was; first come those of number 0.
`bank_choosers.py FOLDER` then compares choosers offline, in seconds. The folder belongs outside the repository.

Notation: c candidates, n observed points, w vertices compared with the silhouette, k modes.
"""

import argparse
import json
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from bank_views import CONDITIONS, OBJECTS, OTHERS, BankView, bank_view, scene_of
from jaxtyping import Float
from search import OBJECTS as SHIPPED

from mereo.fitting import modes, search
from mereo.fitting.draws import fit as draws_fit
from mereo.fitting.modes import ScoredFit, refined
from mereo.fitting.problem.evidence import SILHOUETTE_PITCHES, Evidence
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.problem.problem import Misfit, Problem
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration import answer_frame as answering
from mereo.fitting.registration import register
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.geometry.camera import PointCloud
from mereo.geometry.metrics import (
    TruthGrid,
    grid_confusion,
    intersection_over_union,
    labels_on,
    truth_grid,
    with_segments_exchanged,
)
from mereo.geometry.transforms import transform_points
from mereo.io.cores import use_threads
from mereo.models.weights_place import statistical_model_in
from mereo.scenes.random_states import kept_model
from mereo.scenes.statistical_model import StatisticalModel
from mereo_learning.cases import RegistrationErrors, nearest_truth, seen_points
from mereo_learning.scoring import true_material

CELLS = 48
"""Cells of the truth along each axis."""

FAR = 2.5
"""Distance, in scene units, up to which an observed point is compared along its line of sight."""

FITTED = ("fitted", "turned", "noisy", "heavier")
"""Stages of the fits of the modes. Besides there are "screened" and "bent", which are kept and not measured, "rest" and
"draws", "settled" and "draws settled", the ends under noise, and "truth", the model's own nearest to the true state,
with "from truth", the fit that starts there."""

WITHIN: dict[str, str] = {
    "turn": "turned",
    "in_problem": "noisy",
    "with_heavier_cloud": "heavier",
    "fit_rest": "rest",
    "settled": "settled",
}
"""Stage of what is scored within a function of the fit."""


@dataclass(eq=False)
class Candidate:
    """State that was scored, in the problem in which it was."""

    stage: str
    problem: Problem
    unit: float
    posed: Posed
    surface: Surface | None = None
    misfit: Misfit | None = None

    def is_same(self, other: "Candidate") -> bool:
        """Whether another one is the same state in the same problem."""
        mine, its = self.posed, other.posed
        if self.surface is not None and other.surface is not None and not len(mine.z):
            return self.problem is other.problem and np.array_equal(self.surface.material, other.surface.material)
        return (
            self.problem is other.problem
            and len(mine.z) == len(its.z)
            and np.array_equal(mine.z, its.z)
            and np.array_equal(mine.translation, its.translation)
        )


@dataclass(eq=False)
class Recorder:
    """All candidates of one frame, in the order in which they were made."""

    unit: float = 1.0
    candidates: list[Candidate] = field(default_factory=list)
    drawn: dict[str, Any] | None = None

    def add(
        self, stage: str, problem: Problem, posed: Posed, surface: Surface | None = None, misfit: Misfit | None = None
    ) -> None:
        """Keep a state, unless it is there."""
        new = Candidate(stage, problem, self.unit, posed, surface, misfit)
        if not any(new.is_same(each) for each in self.candidates[-40:]):
            self.candidates.append(new)


def stage_of_caller() -> str:
    """Stage of what is scored, by the functions of the fit that are at work."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if frame.f_code.co_name in WITHIN:
            return WITHIN[frame.f_code.co_name]
        frame = frame.f_back
    return "fitted"


@contextmanager
def recording() -> Iterator[Recorder]:
    """Record everything that the fit scores."""
    recorder = Recorder()
    of, few, screened = ScoredFit.of, modes.bend_by_few, search.screen_poses
    evidence, descend, is_drawn = CloudToFit.evidence, draws_fit.descend, register.is_drawn

    def recorded_of(problem: Problem, posed: Posed) -> ScoredFit:
        scored = of(problem, posed)
        recorder.add(stage_of_caller(), problem, posed, scored.surface, scored.misfit)
        return scored

    def recorded_few(problem: Problem, states: list[Posed], kept: int) -> list[tuple[float, Posed]]:
        ranked = few(problem, states, kept)
        for _, posed in ranked:
            recorder.add("bent", problem, posed)
        return ranked

    def recorded_poses(problem: Problem, screening: search.Screening) -> list[Posed]:
        poses = screened(problem, screening)
        for posed in poses:
            recorder.add("screened", problem, posed)
        return poses

    def recorded_evidence(cloud: CloudToFit, unit: float, *most: int) -> Any:
        recorder.unit = unit
        return evidence(cloud, unit, *most)

    def recorded_descent(problem: Any, fit: Any, fresh: int) -> Any:
        drawn = descend(problem, fit, fresh)
        stage = "draws settled" if stage_of_caller() == "settled" else "draws"
        recorder.add(stage, problem.base, drawn.posed, drawn.surface, Misfit(np.nan, drawn.misfit))
        return drawn

    def recorded_choice(problem: Any, drawn: Any, posed: Posed, rest: ScoredFit | None = None) -> bool:
        taken = is_drawn(problem, drawn, posed, rest)
        recorder.drawn = {"misfit": drawn.misfit, "narrowing": draws_fit.narrowing(problem, drawn), "taken": taken}
        return taken

    patches: list[tuple[Any, str, Any]] = [
        (register, "is_drawn", recorded_choice),
        (ScoredFit, "of", staticmethod(recorded_of)),
        (modes, "bend_by_few", recorded_few),
        (search, "bend_by_few", recorded_few),
        (search, "screen_poses", recorded_poses),
        (CloudToFit, "evidence", recorded_evidence),
        (draws_fit, "descend", recorded_descent),
    ]
    before = [(place, name, place.__dict__[name]) for place, name, _ in patches]
    try:
        for place, name, new in patches:
            setattr(place, name, new)
        yield recorder
    finally:
        for place, name, old in before:
            setattr(place, name, old)


# --- what is measured of a candidate ----------------------------------------------------------------------------------


def scored(truth: TruthGrid, model: StatisticalModel, material: Float[np.ndarray, "m 3"]) -> tuple[float, float]:
    """IoU and mIoU of posed material points; where segments may be exchanged, the best."""
    confusion = grid_confusion(truth, labels_on(model.mesh(material), truth.grid), len(model.rest.names))
    found = intersection_over_union(with_segments_exchanged(confusion, model.swaps))
    return found.iou, found.miou


def information(problem: Problem, posed: Posed) -> tuple[float, Float[np.ndarray, " k"]]:
    """What one observed point of standard deviation 1 says on average: of the pose, and of the modes beside it.

    Logarithm of the determinant of the pose's part, without the scale's, and eigenvalues of the modes' that is left.
    """
    jacobian, _, weight, _ = problem.cloud_rows(posed)
    weight = weight / max(float(weight.sum()), 1e-12)
    matrix = NormalEquations.nothing(jacobian.shape[1]).add(jacobian, np.zeros(len(jacobian)), weight).matrix
    pose = matrix[:6, :6] + 1e-9 * np.trace(matrix[:6, :6]) * np.eye(6)
    cross, modes_part = matrix[:6, POSE:], matrix[POSE:, POSE:]
    left = modes_part - cross.T @ np.linalg.solve(pose, cross)
    return float(np.linalg.slogdet(pose)[1]), np.maximum(np.linalg.eigvalsh(left), 0.0)


def terms_of(candidate: Candidate) -> dict[str, Any]:
    """Terms of a fitted candidate: offsets of all observed points, and how far each vertex is ruled out."""
    problem, posed = candidate.problem, candidate.posed
    surface = candidate.surface
    assert surface is not None
    vertices = surface.material[problem.model.silhouette_vertices]
    _, amount = problem.evidence.violations(vertices, 0.0)
    is_past = np.zeros(len(vertices), dtype=bool)
    if isinstance(problem.evidence, Evidence):
        angle = problem.evidence.sight.query(vertices / np.linalg.norm(vertices, axis=1, keepdims=True))[0]
        is_past = angle > SILHOUETTE_PITCHES * problem.evidence.pitch
    is_modes = len(posed.z) == problem.model.count and not candidate.stage.startswith("draws")
    pose_part, eigenvalues = information(problem, posed) if is_modes else (np.nan, np.full(problem.model.count, np.nan))
    return {
        "offsets": problem.offsets(surface, FAR).astype(np.float16),
        "ruled_out": np.where(is_past, -amount, amount).astype(np.float16),
        "pose_information": pose_part,
        "information": eigenvalues.astype(np.float32),
        "pairs": problem.pairs.energy(posed.z) if is_modes else 0.0,
        "narrowing": modes.narrowing(problem, posed) if is_modes and len(posed.z) else 0.0,
        "explains": candidate.misfit is not None and problem.explained(surface),
        "left_noise": problem.left_noise(surface),
        "material": surface.material,
    }


@lru_cache(maxsize=2)
def registrar_of(name: str) -> Registrar:
    """Registrar of an object's own model, without a network."""
    scene = scene_of(name)
    model = statistical_model_in(name) if name in SHIPPED else kept_model(scene)
    assert model is not None
    registrar = Registrar(None, model, "auto", scene)
    registrar.prepare()
    return registrar


def from_truth(recorder: Recorder, material: Float[np.ndarray, "m 3"], model: StatisticalModel) -> None:
    """Fit from the truth in every problem that was worked on."""
    problems = list(dict.fromkeys(id(each.problem) for each in recorder.candidates if each.stage in FITTED))
    by_id = {id(each.problem): each for each in recorder.candidates}
    for which in problems:
        one = by_id[which]
        problem = one.problem
        if problem.model.count != model.count:
            continue
        T, z = model.project(material / one.unit)
        start = Posed(T[:3, :3], T[:3, 3], z)
        recorder.unit = one.unit
        for stage, fit in (("truth", ScoredFit.of(problem, start)), ("from truth", refined(problem, start))):
            recorder.candidates.append(Candidate(stage, problem, one.unit, fit.posed, fit.surface, fit.misfit))


def record(frame: BankView) -> dict[str, Any]:
    """All arrays of one frame."""
    registrar = registrar_of(frame.name)
    model = registrar.model
    started = time.perf_counter()
    answer = None
    refused = ""
    with recording() as recorder:
        try:
            answer = answering.answer_frame(frame.seen, None, registrar, scene_unit=frame.scene_unit)
        except ValueError as error:
            refused = str(error)
        seconds = time.perf_counter() - started
    truth, material, factor = None, None, 1.0
    if frame.view is not None:
        factor = size_of(frame)
        T = np.eye(4) if answer is None else answer.T_camera_input
        truth = truth_grid(frame.view.mesh.transformed(T), CELLS)
        material = transform_points(T, factor * true_material(frame.view, model))
        from_truth(recorder, material, model)
    return packed(frame, recorder, answer, refused, seconds, truth, material, factor)


def size_of(frame: BankView) -> float:
    """Length of a scene unit in the frame's unit, by the truth."""
    assert frame.view is not None
    if frame.condition != "unknown-unit":
        return 1.0
    seen, own = frame.seen.frame.cloud.points, frame.view.depth.to_points().points
    return float(np.linalg.norm(seen, axis=1).mean() / np.linalg.norm(own, axis=1).mean())


def packed(
    frame: BankView,
    recorder: Recorder,
    answer: Answer | None,
    refused: str,
    seconds: float,
    truth: TruthGrid | None,
    material: Float[np.ndarray, "m 3"] | None,
    factor: float,
) -> dict[str, Any]:
    """Arrays of a frame's candidates, and all other facts as JSON."""
    problems = list({id(each.problem): each.problem for each in recorder.candidates}.values())
    number_of = {id(problem): number for number, problem in enumerate(problems)}
    evidences = list({id(problem.evidence.points): problem.evidence for problem in problems}.values())
    rows = list[dict[str, Any]]()
    arrays = dict[str, Any]()
    final = None if answer is None or answer.registration is None else answer.registration
    offsets, ruled, eigenvalues, places = (list[np.ndarray]() for _ in range(4))
    for candidate in recorder.candidates:
        row: dict[str, Any] = {
            "stage": candidate.stage,
            "problem": number_of[id(candidate.problem)],
            "unit": candidate.unit,
            "pose": [
                *candidate.posed.rotation.ravel().tolist(),
                *candidate.posed.translation.tolist(),
                candidate.posed.log_scale,
            ],
            "z": candidate.posed.z.tolist(),
        }
        if candidate.misfit is not None:
            misfit = candidate.misfit
            row |= {"cloud": misfit.cloud, "total": misfit.total, "measured": len(offsets)}
            terms = terms_of(candidate)
            offsets.append(terms.pop("offsets"))
            ruled.append(terms.pop("ruled_out"))
            eigenvalues.append(terms.pop("information"))
            posed_material = terms.pop("material") * candidate.unit
            if candidate.stage in ("draws", "draws settled", "rest"):
                row["material"] = len(places)
                places.append(posed_material.astype(np.float32))
            row |= terms
            if truth is not None and material is not None:
                row["iou"], row["miou"] = scored(truth, candidate.problem.model, posed_material / factor)
                row["off"] = float(np.sqrt(((posed_material - material) ** 2).sum(axis=1).mean())) / factor
            row["chosen"] = final is not None and bool(
                len(final.material) == len(posed_material)
                and np.abs(final.material - posed_material).max() < 1e-6 * candidate.unit
            )
        rows.append(row)
    arrays |= {"offsets": stacked(offsets), "ruled_out": stacked(ruled), "information": stacked(eigenvalues)}
    for number, each in enumerate(places):
        arrays[f"material{number}"] = each
    for number, evidence in enumerate(evidences):
        arrays[f"points{number}"] = evidence.points.astype(np.float32)
        arrays[f"around{number}"] = evidence.around.astype(np.int16)
    facts = {
        "object": frame.name,
        "condition": frame.condition,
        "number": frame.number,
        "kind": frame.kind,
        "is_object": frame.view is not None,
        "half": recorder.candidates[0].problem.model.half if recorder.candidates else None,
        "seconds": seconds,
        "refused": refused,
        "drawn": recorder.drawn,
        "candidates": rows,
        "problems": [
            {
                "other_lines": each.evidence.other_lines,
                "is_open": each.evidence.is_open,
                "cloud_sigma": each.cloud_sigma,
                "cloud_weight": each.config.cloud_weight,
                "noisy": each.is_noisy,
                "scale_open": each.is_scale_open,
                "samples": len(each.evidence.observed_samples),
                "points": len(each.evidence.points),
                "evidence": next(n for n, one in enumerate(evidences) if one.points is each.evidence.points),
                "roughness": each.evidence.roughness,
                "hidden_edge": each.evidence.hidden_edge,
                "modes": each.model.count,
            }
            for each in problems
        ],
        "answer": None if answer is None else answer_facts(frame, answer, truth, material, factor),
    }
    arrays["facts"] = np.frombuffer(json.dumps(facts, default=float).encode(), dtype=np.uint8)
    return arrays


def stacked(rows: Sequence[Float[np.ndarray, " _"]]) -> Float[np.ndarray, "r w"]:
    """Rows of an array, the shorter ones with NaN at their ends."""
    width = max(map(len, rows), default=0)
    ends = [np.pad(row, (0, width - len(row)), constant_values=np.nan) for row in rows]
    return np.stack(ends) if ends else np.empty((0, 0))


def answer_facts(
    frame: BankView, answer: Answer, truth: TruthGrid | None, material: Float[np.ndarray, "m 3"] | None, factor: float
) -> dict[str, Any]:
    """What the answer says, and how far it is from the truth."""
    said, fit = answer.recognition, answer.registration
    facts: dict[str, Any] = said.facts()
    if fit is None:
        return facts
    facts |= {"method": fit.method, "explained": fit.explained, "accepted": fit.accepted, "residual": fit.residual}
    facts["expected_iou"] = fit.expected_iou
    if truth is None or material is None:
        return facts
    facts["iou"], facts["miou"] = scored(truth, fit.model, fit.material / factor)
    positions = nearest_truth(fit.model, fit.material, material)
    seen = seen_points(positions, PointCloud(transform_points(answer.T_camera_input, frame.seen.cloud.points)), factor)
    errors = RegistrationErrors.of(fit, positions, seen, factor)
    assert fit.uncertainty is not None
    for name, which in (("seen", seen), ("hidden", ~seen)):
        if which.any():
            inside = float((errors.ratios[which] <= 1.0).mean())
            facts[name] = [inside, float(np.median(errors.distances[which])), float(np.median(errors.radii[which]))]
    return facts


# --- one command ------------------------------------------------------------------------------------------------------


def make(name: str, condition: str, number: int, folder: Path) -> str:
    """Make one frame's file where it is not there; say what came of it."""
    kept = folder / name / f"{condition}-{number}.npz"
    if kept.is_file():
        return "kept"
    started = time.perf_counter()
    try:
        arrays = record(bank_view(name, condition, number))
    except Exception:  # one frame must not end the bank: its error is kept and shown
        kept.with_suffix(".error").write_text(traceback.format_exc(), encoding="utf-8")
        return "ERROR"
    partial = kept.with_suffix(".part")
    with partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    partial.replace(kept)
    kept.with_suffix(".error").unlink(missing_ok=True)  # of an earlier run
    return f"made in {time.perf_counter() - started:.1f} s"


def make_several(name: str, frames: Sequence[tuple[str, int]], folder: Path) -> None:
    """Make the missing ones of some frames of an object."""
    for condition, number in frames:
        what = make(name, condition, number, folder)
        if what != "kept":
            print(f"{name}/{condition}-{number} {what}", flush=True)


def main() -> None:
    """Make what is missing of the bank."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.processes, initializer=use_threads, initargs=(1,)) as pool:
        made = []
        for number in range(given.views):
            kinds = range(number, len(OTHERS), given.views)
            for name in given.objects:
                (given.folder / name).mkdir(parents=True, exist_ok=True)
                frames = [(condition, number) for condition in given.conditions if condition != "other"]
                frames += [("other", kind) for kind in kinds if "other" in given.conditions]
                made.append(pool.submit(make_several, name, frames, given.folder))
        for each in made:
            each.result()


if __name__ == "__main__":
    main()
