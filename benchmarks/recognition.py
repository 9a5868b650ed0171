"""Is it my object, in a state that I know: how well the answer tells, and how reliable probabilities are.

    python benchmarks/recognition.py [OBJECT ...] [--views N] [--strangers N] [--seed S] [--calibration-views N]
                                     [--method modes|auto] [--output FOLDER]

For each object, with its shipped weights or a file of weights: the area under the receiver operating characteristic
(AUROC) by which ``Recognition.strangeness`` tells N clean views of the object from N views of every other shipped
object, from planes and heaps, from clouds in another unit than is stated, from states with all draws 1.5 times as far,
and from the object's own views as a network of the preset `tiny` understands them after ten steps; the shares of
clean and of simulated cameras' views that are "unsure" and refused; and the expected calibration error of the network's
probabilities as they are and calibrated. Weights without a calibration are calibrated here, on training seeds, and not
written. Test seeds begin at 1,000,000: tune on others.

With `--output` each object's row is kept in FOLDER/OBJECT.json as soon as it is measured and FOLDER/table.md has those
of the objects named, so that a run that was cut off goes on where it was: rows of the same settings are not measured
again, and those of others are refused.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from mereo.api.generate import generate
from mereo.deformation.maps import Deformation
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import Recognition
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud
from mereo.geometry.metrics import truth_grid
from mereo.io.atomic_files import atomic_file
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.scenes.draw_recorder import OutOfDraws, Recorder
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene, SourceFrame
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.calibrate import (
    VIEWS,
    CalibrationView,
    calibrate,
    ece_of,
    object_views,
    other_objects,
    strange_frames,
)
from mereo_learning.cases import sample_cells
from mereo_learning.config import PRESETS
from mereo_learning.scoring import trained_scene
from mereo_learning.trainer import train

FACTORS = (25.4, 0.1, 1000.0, 0.0254, 10.0, 1 / 25.4, 0.001, 2.54)
"""Units that are mistaken for each other: inches, millimetres, centimetres, metres."""

KINDS = ("other object", "plane or clutter", "wrong unit", "state beyond", "ten steps")

STEPS, EXAMPLES = 10, 40

CELLS = 100
"""Cells of the paper's grid along each axis."""


@dataclass
class Found:
    """What was said of the frames of one object.

    Attributes:
        own: of clean views.
        noisy: of views by simulated cameras.
        strange: of everything else, by its kind.
        ece: expected calibration error as the network gives probabilities, and calibrated.
    """

    own: list[Recognition] = field(default_factory=list)
    noisy: list[Recognition] = field(default_factory=list)
    strange: dict[str, list[Recognition]] = field(default_factory=lambda: defaultdict(list))
    ece: tuple[float, float] = (float("nan"), float("nan"))


def auroc(own: Sequence[float], strange: Sequence[float]) -> float:
    """Probability that a strange frame is stranger than one of the object's, where equal ones count half."""
    if not len(own) or not len(strange):
        return float("nan")
    ahead = np.subtract.outer(np.asarray(strange), np.asarray(own))
    return float((ahead > 0).mean() + 0.5 * (ahead == 0).mean())


def said_of(cloud: PointCloud, model: Model, registrar: Registrar, unit_m: float | None = 1.0) -> Recognition:
    """What `mereo.reconstruct` says of a cloud of this unit; a scene unit is a metre (``registrar_of``)."""
    return answer_frame(observe(cloud, unit_m=unit_m), model, registrar).recognition


def registrar_of(model: Model, method: AnswerMethod, scene: Scene) -> Registrar:
    """Registrar of an object whose scene unit is said to be a metre, so that the unit of its views is known."""
    own = Registrar.of(model, method, scene)
    return replace(own, model=replace(own.model, source_frame=SourceFrame(np.eye(4), 1.0)))


ATTEMPTS = 50
"""States that are drawn before giving up on a scene that refuses what is beyond its bounds."""

MOST_CALLS = 20_000
"""Calls of the generator after which a scene that draws again and again has refused."""


FULL_TURN = 2 * np.pi
"""Width of an interval of angles that has no end."""


class FartherDraws(Recorder):
    """Generator whose numbers lie beyond what they are drawn from.

    A uniform or triangular number lies farther from the middle (the mode) than its bound does, by a factor: on the side
    on which it was drawn, or, of an interval on one side of zero, on that which is away from zero. A normal one is the
    factor times as far from the mean. Directions of a full turn stay.
    """

    def __init__(self, seed: int, factor: float) -> None:
        super().__init__(seed, {}, MOST_CALLS)
        self.factor = factor

    def _beyond(self, values: Any, low: Any, middle: Any, high: Any) -> Any:
        drawn, low, middle, high = (np.asarray(value, dtype=float) for value in (values, low, middle, high))
        upwards = np.where(low >= 0, True, np.where(high <= 0, False, drawn >= middle))
        return middle + self.factor * (np.where(upwards, high, low) - middle)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Numbers beyond an interval."""
        drawn = super().uniform(low, high, size)
        low, high = np.minimum(low, high), np.maximum(low, high)
        beyond = self._beyond(drawn, low, (low + high) / 2, high)
        return _plain_value(np.where(np.isclose(high - low, FULL_TURN), drawn, beyond))

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers of a greater standard deviation."""
        middle = np.asarray(loc, dtype=float)
        return _plain_value(middle + self.factor * (np.asarray(super().normal(loc, scale, size)) - middle))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Normal numbers of mean 0 and the factor as their standard deviation."""
        return _plain_value(self.factor * np.asarray(super().standard_normal(size, dtype, out)))

    def triangular(self, left: Any, mode: Any, right: Any, size: Any = None) -> Any:
        """Numbers beyond the bounds of a triangular distribution."""
        return _plain_value(self._beyond(super().triangular(left, mode, right, size), left, mode, right))


def _plain_value(values: Any) -> Any:
    """A single number as numpy's generators return it."""
    return values if np.ndim(values) else float(values)


def with_farther_states(scene: Scene, factor: float) -> Scene:
    """The scene with all its draws ``factor`` times as far from their middle as their bounds.

    Its ``sample_deformations`` raises ``ValueError`` where the scene refuses ``ATTEMPTS`` such states.
    """
    return replace(scene, sample_deformations=_farther_sampler(scene, factor))


def _farther_sampler(scene: Scene, factor: float) -> Callable[[np.random.Generator], tuple[Deformation, ...]]:
    def sample(rng: np.random.Generator) -> tuple[Deformation, ...]:
        for _ in range(ATTEMPTS):
            try:
                return scene.sample_deformations(FartherDraws(int(rng.integers(2**31)), factor))
            except (OutOfDraws, ValueError):
                continue
        raise ValueError(
            f"the scene {scene.name!r} allows no state with its draws {factor:g} times as far from their middle as "
            "their bounds: take a smaller factor"
        )

    return sample


def clouds_beyond(scene: Scene, count: int, seed: int) -> Iterator[PointCloud]:
    """Clouds of the object in states whose draws are all 1.5 times as far out; none of a scene that refuses them."""
    with suppress(ValueError):
        for index in range(count):
            rng = example_rng(seed + 4, index)  # beyond the seeds of other strange frames
            yield sample_view(with_farther_states(scene, 1.5), GenerateConfig(), rng).depth.to_points()


def barely_trained(scene: Scene, folder: Path) -> Model:
    """Weights of the preset `tiny` after ten steps."""
    generate(scene, folder / "data", GenerateConfig(), examples=EXAMPLES, seed=3, workers=1)
    tiny = PRESETS["tiny"]
    config = replace(tiny, holdout=8, offset_examples=8, epochs=STEPS * tiny.batch / (EXAMPLES - 8))
    return load_model(train(folder / "data", folder / "run", config, device="cpu"))


def measured(name: str, arguments: argparse.Namespace) -> Found:
    """All frames of one object."""
    model = load_model(name)
    scene = load_scene(arguments.scene or trained_scene(model))
    if model.calibration is None:
        model = replace(model, calibration=calibrate(model, scene, views=arguments.calibration_views, quiet=False))
    registrar, unsized = registrar_of(model, arguments.method, scene), Registrar.of(model, arguments.method, scene)
    found, seed = Found(), arguments.seed
    views = list(object_views(scene, 2 * arguments.views, seed))
    clean = [view for view in views if view.is_clean]
    found.own = [said_of(view.seen, model, registrar) for view in clean]
    found.noisy = [said_of(view.seen, model, registrar) for view in views if not view.is_clean]
    for index, view in enumerate(clean):
        wrong = PointCloud(view.seen.points * FACTORS[index % len(FACTORS)])
        found.strange["wrong unit"].append(said_of(wrong, model, registrar))
    for kind, cloud in strange_frames(scene, other_objects(scene), arguments.strangers, seed):
        found.strange[kind].append(said_of(cloud, model, unsized, unit_m=None))
    for cloud in clouds_beyond(scene, arguments.views, seed):
        found.strange["state beyond"].append(said_of(cloud, model, registrar))
    with TemporaryDirectory() as folder:
        poor = barely_trained(scene, Path(folder))
        of_poor = registrar_of(poor, "modes", scene)
        found.strange["ten steps"] = [said_of(view.seen, poor, of_poor) for view in clean]
    found.ece = calibration_error(model, clean)
    return found


def calibration_error(model: Model, views: Sequence[CalibrationView]) -> tuple[float, float]:
    """Expected calibration error of the probabilities as they are and calibrated, over cells of the paper's metric."""
    logits, truth = [], []
    for view in views:
        points, labels = sample_cells(truth_grid(view.mesh, CELLS))
        logits.append(model.logits(model.encode(view.seen), points))
        truth.append(labels)
    calibration = model.calibration
    assert calibration is not None and calibration.temperature is not None
    every = np.concatenate(logits), np.concatenate(truth)
    return ece_of(*every), ece_of(*every, calibration.scaling)


def row(name: str, found: Found, seconds: float) -> dict[str, str | float | list[float]]:
    """Row of the table: what was found, in numbers."""
    own = [one.strangeness for one in found.own]
    shares = [share(views, said) for views in (found.own, found.noisy) for said in ("unsure", False)]
    return {
        "object": name,
        "auroc": [auroc(own, [one.strangeness for one in found.strange[kind]]) for kind in KINDS],
        "passed": [share(found.strange[kind], True) for kind in KINDS],
        "frames": [len(found.own), len(found.noisy), *(len(found.strange[kind]) for kind in KINDS)],
        "told": shares,
        "ece": list(found.ece),
        "seconds": round(seconds),
    }


def line(one: dict[str, Any]) -> str:
    """Row as a line of the table."""
    cells = [f"{area:.3f} ({rate:.0%})" for area, rate in zip(one["auroc"], one["passed"], strict=True)]
    cells += [f"{rate:.0%}" for rate in one["told"]] + [f"{error:.3f}" for error in one["ece"]]
    cells += [", ".join(str(count) for count in one["frames"]), str(one["seconds"])]
    return f"| {one['object']} | {' | '.join(cells)} |"


def share(said: Sequence[Recognition], known: object) -> float:
    """Share of frames of which this was said."""
    return sum(one.known == known for one in said) / len(said) if said else float("nan")


def kept_row(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """The object's row: that in the folder, where one is, or else measured and kept there."""
    place = None if arguments.output is None else arguments.output / f"{Path(name).stem}.json"
    settings = {key: str(value) for key, value in vars(arguments).items() if key not in ("objects", "output")}
    if place is not None and place.is_file():
        kept: dict[str, Any] = json.loads(place.read_text(encoding="utf-8"))
        if kept["settings"] != settings:
            raise SystemExit(f"{place} has a row of other settings ({kept['settings']}): name another folder")
        return kept
    started = time.perf_counter()
    found: dict[str, Any] = {**row(name, measured(name, arguments), time.perf_counter() - started)}
    found["settings"] = settings
    if place is not None:
        with atomic_file(place) as partial:
            partial.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["bunny", "liver", "rope", "robot"])
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--strangers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=TEST_SEED_START)
    parser.add_argument("--calibration-views", type=int, default=VIEWS)
    parser.add_argument("--scene", default=None)
    parser.add_argument("--method", default="modes", choices=("modes", "auto"))
    parser.add_argument("--output", type=Path, default=None)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    heads = [f"{kind} (known)" for kind in KINDS]
    heads += ["own unsure", "own refused", "cameras' unsure", "refused", "ECE", "calibrated"]
    heads += ["frames: own, cameras', each kind", "seconds"]
    lines = [f"| AUROC against | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    print("\n".join(lines), flush=True)
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.objects:
        lines.append(line(kept_row(name, arguments)))
        print(lines[-1], flush=True)
        if arguments.output is not None:
            (arguments.output / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
