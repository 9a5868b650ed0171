"""``mereo learn``: whether an object needs training, and its weights if so, in stages that each leave something whole.

    object -check-> search alone -good enough-> scores, and a frame to try
                         '--else--> measure -plan-> generate -> train -> evaluate -> these, a report, and weights

Scores and plan are written down once they are made, so the same command continues where it was stopped, with the same
numbers.
"""

import json
import math
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from mereo.geometry.metrics import format_score
from mereo.geometry.transforms import longest_side
from mereo.io.atomic_files import MARKER, check_place, scratch_folder, write_file, write_json
from mereo.io.config import CONFIG
from mereo.io.errors import words_of
from mereo.io.object_storage import claim
from mereo.io.progress import Progress, progress
from mereo.io.writers.meshes import write_positions_ply
from mereo.models.device import keep_freed_memory, pick_device
from mereo.models.weights import load_model, with_calibration
from mereo.models.weights_place import NOT_SHIPPED, WEIGHTS, find_weights, shipped_names
from mereo.scenes.files.check import check_scene
from mereo.scenes.files.object_files import SCENE, SEARCH, names_scene, scene_of_folder, shapes_in
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import sample_view
from mereo.workers.spread import Cluster, spread
from mereo_learning.calibrate import LEAST_VIEWS, VIEWS, calibrate
from mereo_learning.config import PRESETS, TrainConfig
from mereo_learning.dataset import Dataset, Draws
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.processes import Process
from mereo_learning.run_directory import fit_config, start_network
from mereo_learning.scoring import EvaluationConfig, evaluate
from mereo_learning.search_stage import (
    GOOD_ENOUGH,
    LOWEST,
    SEARCH_SHARE,
    TrainChoice,
    best_method,
    is_to_train,
    scores_of_views,
    search_line,
    search_scores,
    shortcomings,
    symmetry_lines,
    training_reason,
)
from mereo_learning.shards import DatasetConfig, generate
from mereo_learning.tables import CLEARLY, read_metrics
from mereo_learning.trainer import VALIDATIONS, Trainer
from mereo_learning.trainer import train as train_network
from mereo_learning.validation import validate

# --- schedule ---------------------------------------------------------------------------------------------------------

EVALUATION_SHARE = 0.15
"""Of the time that is left after the measurements, for the scores: whose number says how far they can be trusted."""

PASSES = 3.0
"""Times that each example is learnt from, where time allows no more: further ones gain less than new examples."""

MARGIN = 0.93
"""Share of the time for training that is planned: the machine may have more to do by then."""

LEAST_EXAMPLES, MOST_EXAMPLES, LEAST_TESTS, MOST_TESTS = 60, 48_000, 4, 64

OFFSET_EXAMPLES = 128
"""Training examples from which class offsets are chosen."""


@dataclass(frozen=True)
class Rates:
    """Seconds that an example takes to be made by all processes together, to be learnt from, and to be answered."""

    generate_s: float
    train_s: float
    score_s: float


@dataclass(frozen=True)
class Plan:
    """Use of the time: the weights to start from, examples and passes over them, and the seconds of each stage.

    ``training_s`` is with all that is scored meanwhile; ``evaluation_s`` is kept for the scores.
    """

    init: str
    examples: int
    epochs: float
    generation_s: float
    training_s: float
    evaluation_s: float


def plan_for(left_s: float, rates: Rates, init: str, batch: int) -> Plan:
    """Plan for ``left_s`` seconds; where these are too few, the least that can be trained, and so longer.

    Examples are made until each is learnt from ``PASSES`` times in what is left then.
    """
    left_s = max(left_s, 0.0)
    work_s = left_s * (1 - EVALUATION_SHARE)

    def fits(examples: int) -> bool:
        steps_s = PASSES * (examples - holdout(examples)) * rates.train_s
        return examples * rates.generate_s + (steps_s + _scored_s(examples, rates)) / MARGIN <= work_s

    examples = LEAST_EXAMPLES
    while examples < MOST_EXAMPLES and fits(examples + 1):
        examples += 1
    generation_s = examples * rates.generate_s
    return epochs_for(work_s - generation_s, rates, init, examples, batch, generation_s, left_s * EVALUATION_SHARE)


def epochs_for(
    training_s: float,
    rates: Rates,
    init: str,
    examples: int,
    batch: int,
    generation_s: float = 0.0,
    evaluation_s: float = 0.0,
) -> Plan:
    """Plan for examples that are there already, and so many seconds of training."""
    learnt = examples - holdout(examples)
    steps_s = MARGIN * training_s - _scored_s(examples, rates)
    epochs = max(1.0, steps_s / rates.train_s / learnt)
    epochs = math.ceil(epochs * learnt / batch) * batch / learnt  # whole steps
    expected_s = (epochs * learnt * rates.train_s + _scored_s(examples, rates)) / MARGIN
    return Plan(init, examples, epochs, generation_s, expected_s, evaluation_s)


def holdout(examples: int) -> int:
    """Examples held out of so many for the validation curve, which has 20 scores, each of all of them."""
    return min(32, examples // 10)


def views_for(left_s: float, each_s: float) -> int:
    """Number of test views that can be scored in ``left_s`` seconds at ``each_s`` for one."""
    return int(max(LEAST_TESTS, min(MOST_TESTS, left_s / max(each_s, 1e-3))))


def _scored_s(examples: int, rates: Rates) -> float:
    """Seconds of training that are no steps: the validation curve and the class offsets."""
    return (VALIDATIONS * holdout(examples) + min(OFFSET_EXAMPLES, examples)) * rates.score_s


# --- learn ------------------------------------------------------------------------------------------------------------

PLAN, METRICS = "plan.json", "metrics.json"
"""What was decided, with the measurements behind it; scores of the search alone and, where there are weights, of both,
and which to use."""

DATA, RUN, TEST = "data", "run", "test"

FRAME = "frame.ply"
"""File of a frame to try the object on."""

Learnable = tuple[str, list[Path]]
"""Name and files of an object."""

SEED = 1
"""Of examples and training. What is learnt from another one differs by chance alone."""

CALIBRATION_SHARE = 0.25
"""Of the time for the scores: what is then said of them, and of every later frame, rests on it."""

TIMED = 2
"""Test views that are timed, to know how many there is time for."""


@dataclass(frozen=True)
class LearnConfig:
    """Settings of learning an object.

    Attributes:
        minutes: the budget of all stages together.
        init: weights to start from; empty compares the shipped ones.
        units: of the meshes; guessed where not given.
        workers: processes that make examples.
        train: "auto" trains where the search alone is not good enough (``search_stage.shortcomings``), or where that
            was begun in the folder; "always" in any case; "never" not at all.
    """

    minutes: float = 10.0
    init: str = ""
    units: str | None = None
    workers: int = 1
    train: TrainChoice = "auto"


@dataclass
class Clock:
    """Time of one run of the command, out of its budget."""

    budget_s: float
    started: float = field(default_factory=time.monotonic)

    @property
    def left_s(self) -> float:
        """Seconds of the budget that are left; below 0 where it is overdrawn."""
        return self.budget_s - (time.monotonic() - self.started)

    def stage(self, number: int, what: str) -> None:
        """Print which stage begins, and the time left."""
        left = f"{self.left_s / 60:.1f} of {self.budget_s / 60:g} min left" if self.left_s > 0 else "out of time"
        print(f"[{number}/6] {what} ({left})", flush=True)


def learn(
    files: Sequence[Path],
    output: Path,
    config: LearnConfig = LearnConfig(),
) -> dict[str, Any]:
    """Learn an object in about so many minutes, where it needs that; returns the scores as ``metrics.json`` has them.

    Args:
        files: a scene's name or file, or the object's meshes, as ``mereo scene new`` takes them.
        output: folder to create; one that the same call has begun is continued.
        config: the settings.

    Raises ``ValueError`` for other settings than the folder was begun with, and as the stages do.
    """
    clock = Clock(60 * config.minutes)
    units = config.units
    train = config.train
    if config.init:
        find_weights(config.init)  # a name that is none is better said before the work
    elif train != "never" and not shipped_names():
        raise FileNotFoundError(f"there are no weights to start from: name some with --init, or {NOT_SHIPPED}")
    if not (output / PLAN).is_file() and not (output / SEARCH).is_file():
        clock.stage(1, "check the object")
        check_object(files, units)
    paths = [place_of_scene(file) for file in files]
    _claim(output, {"object": paths, "minutes": config.minutes, "init": config.init, "units": units})
    is_begun = (output / PLAN).is_file()
    if is_begun and train == "never":
        raise ValueError(
            f"{output} was trained, or begun to be, but --train is never: leave it out to go on, or choose another "
            "--output"
        )
    scene = scene_for(files, output, units)
    loaded = load_scene(scene)
    named = place_of_scene(Path(scene))
    clock.stage(2, "score the search alone, without training")
    searched = search_scores(output, loaded, named, SEARCH_SHARE * clock.budget_s)
    reasons = shortcomings(searched.summary())
    print(search_line(searched), *symmetry_lines(loaded), sep="\n", flush=True)
    if is_begun or is_to_train(train, reasons):
        print(f"it is trained: {training_reason(train, reasons, is_begun)}", flush=True)
        _train(scene, output, clock, config, searched.summary()["seconds"])
        test = read_metrics(output / TEST / "metrics.json")
        metrics = _comparison(scores_of_views(output, loaded, named, test["examples"]).summary(), test)
        advice = advice_after_training(metrics, test["per_segment"], config.minutes)
    else:
        metrics = {"trained": False, "method": "search", **searched.summary(), "search": searched.summary()}
        advice = _advice_without_training(reasons, files, output, config)
    write_json(output / METRICS, metrics)
    frame = write_example_frame(loaded, output / FRAME)
    _show_outcome(metrics, advice, output, scene, frame, (time.monotonic() - clock.started) / 60)
    return metrics


def _train(scene: str, output: Path, clock: Clock, config: LearnConfig, search_s: float) -> None:
    """Measure, generate, train, calibrate and evaluate; the search will take ``search_s`` seconds of each test view."""
    recipe = recipe_for(clock.budget_s / 60)
    begun = _decided(output)
    plan = _measured(scene, output, recipe, clock, config) if begun is None else begun
    clock.stage(4, f"generate {plan.examples} examples, about {_duration(plan.generation_s)}")
    dataset = DatasetConfig(MADE_AS, plan.examples, SEED)
    generate(scene, output / DATA, dataset, workers=config.workers, resume=True)
    if begun is None:
        plan = _revised(output, plan, clock, recipe.batch)
    clock.stage(
        5, f"train from the weights of {plan.init}, {plan.epochs:.1f} passes, about {_duration(plan.training_s)}"
    )
    offsets = min(OFFSET_EXAMPLES, plan.examples)
    recipe = replace(
        recipe, init=plan.init, epochs=plan.epochs, holdout=holdout(plan.examples), offset_examples=offsets
    )
    weights = train_network(output / DATA, output / RUN, recipe, checkpoint_every_s=60.0)
    clock.stage(6, "calibrate, and evaluate on views that training has not seen")
    is_evaluated = (output / TEST / MARKER).is_file()
    if not is_evaluated or not (output / WEIGHTS).is_file():
        each_s = _calibrated(weights, output, scene, max(clock.left_s, plan.evaluation_s))
        if not is_evaluated:
            left_s = max(clock.left_s, (1 - CALIBRATION_SHARE) * plan.evaluation_s)
            examples = views_for(left_s, each_s + search_s)
            evaluate_weights(output / WEIGHTS, output / TEST, EvaluationConfig(scene, examples))


def recipe_for(minutes: float) -> TrainConfig:
    """Recipe for a budget, but for what the plan decides."""
    # compiling takes a minute or two; in an hour that is left to ``compiling_pays``
    return replace(PRESETS["base"], compile="auto" if minutes >= 60 else "off", seed=SEED)


# --- what is kept between runs of the command -------------------------------------------------------------------------


def _claim(output: Path, settings: dict[str, Any]) -> None:
    """Take the folder, or check that it was begun with the same arguments: they bind once something is made of them."""
    before = claim(output, CONFIG, settings, "what is learnt")
    planned = (output / PLAN).is_file()
    written = (output / SCENE).is_file()
    for name, value in settings.items():
        binds = planned or (written and name in ("object", "units"))
        if before is not None and binds and before.get(name) != value:
            raise ValueError(
                f"{output} was begun with {name} = {before.get(name)!r}, not {value!r}; it is continued with equal "
                "arguments: repeat those, or choose another --output"
            )
    if before not in (None, settings):
        write_json(output / CONFIG, settings)


def _decided(output: Path) -> Plan | None:
    """The plan that an earlier run has made."""
    path = output / PLAN
    if not path.is_file():
        return None
    try:
        return Plan(**json.loads(path.read_text("utf-8"))["plan"])
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} holds no plan; remove it, and it is made again") from None


def _measured(scene: str, output: Path, recipe: TrainConfig, clock: Clock, config: LearnConfig) -> Plan:
    """The plan by what is measured, which is written down."""
    clock.stage(3, "measure this machine, and choose weights to start from")
    with scratch_folder(output / "measured") as scratch:
        rates, init = measure(scene, scratch, recipe, init=config.init, workers=config.workers)
    plan = plan_for(clock.left_s, rates, init, recipe.batch)
    expected_s = plan.generation_s + plan.training_s + plan.evaluation_s
    if expected_s > 1.1 * max(clock.left_s, 0.0):
        print(f"warning: the least that can be learnt from takes {_duration(expected_s)} from here, more than is left")
    write_json(output / PLAN, {"plan": asdict(plan), "rates": asdict(rates)})
    return plan


def _revised(output: Path, plan: Plan, clock: Clock, batch: int) -> Plan:
    """The plan with as much training as there is time for, now that the examples are there."""
    rates = json.loads((output / PLAN).read_text("utf-8"))["rates"]
    again = epochs_for(clock.left_s - plan.evaluation_s, Rates(**rates), plan.init, plan.examples, batch)
    plan = replace(plan, epochs=again.epochs, training_s=again.training_s)
    write_json(output / PLAN, {"plan": asdict(plan), "rates": rates})
    return plan


def _calibrated(weights: Path, output: Path, scene: str, left_s: float) -> float:
    """Put the weights of the run, calibrated, into the folder; returns the seconds that a test view takes."""
    started = time.monotonic()
    evaluate(load_model(weights), EvaluationConfig(scene, TIMED))
    each_s = (time.monotonic() - started) / TIMED
    views = min(max(views_for(CALIBRATION_SHARE * left_s, each_s), LEAST_VIEWS), VIEWS)
    # other things than the object would take as long again, and only place the second limit of recognition
    calibration = calibrate(load_model(weights), scene, views=views, quiet=False)
    write_file(output / WEIGHTS, with_calibration(weights, calibration))
    return each_s


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"


# --- speed of this machine --------------------------------------------------------------------------------------------

MADE_AS = GenerateConfig(sampling=SamplingConfig(uniform_fraction=0.15))
"""How examples are made: with the share of uniform queries that the schedule was measured with; the paper's is more."""

EXAMPLES = 48
"""Examples that are measured; they are of the seed of training, and are made again with the others."""


def measure(scene: str, folder: Path, recipe: TrainConfig, *, init: str, workers: int) -> tuple[Rates, str]:
    """Seconds that examples take, and the weights to start from: ``init``, or those of the shipped that adapt fastest.

    A small dataset and short runs are made in ``folder``, which the caller removes. Raises ``ValueError`` where an
    example cannot be made, or the weights do not fit the recipe.
    """
    started = time.monotonic()
    with redirect_stdout(StringIO()):  # nobody waits for these few
        generate(scene, folder / "data", DatasetConfig(MADE_AS, EXAMPLES, SEED))
    # with the template and 100 states, so a little too long; another process adds 0.8, as cores share memory and caches
    generate_s = (time.monotonic() - started) / EXAMPLES / (1 + 0.8 * (workers - 1))
    keep_freed_memory()
    data = Dataset.load(folder / "data", pick_device())
    with progress("measure", trial_steps(compared=not init), "steps") as shown:
        losses = {} if init else nearest(data, recipe, folder, shown)
        init = init or next(iter(losses))
        rates = Rates(generate_s, *timed(data, replace(recipe, init=init), folder, shown))
    if losses:
        listed = ", ".join(f"{name} {loss:.2f}" for name, loss in losses.items())
        print(f"loss after {STEPS} steps from the weights of {listed}", flush=True)
    return rates, init


# --- short trainings --------------------------------------------------------------------------------------------------

COMPARED = 24
"""Examples on which all shipped weights are compared as they are."""

FINALISTS = 3
"""How many of these, those with the lowest loss, are then trained."""

STEPS = 12
"""Steps of a trial: a training of its own, with warm-up and decay."""

JUDGED = 4
"""Steps, the last ones, whose mean loss is compared."""

SCORED = 16
"""Examples from which the time of an answer is taken."""


def trial_steps(compared: bool) -> int:
    """Steps of ``timed``, and before it of ``nearest`` where weights are ``compared``, as progress counts them."""
    shipped = len(shipped_names())
    return STEPS + (shipped + min(FINALISTS, shipped) * STEPS if compared else 0)


def nearest(data: Dataset, recipe: TrainConfig, folder: Path, shown: Progress) -> dict[str, float]:
    """Shipped weights nearest to a dataset, the best first, each with its loss after a trial.

    All are compared by their loss as they are; the ``FINALISTS`` among them then by that after a trial.

    Args:
        data: a few examples.
        recipe: of the training to come.
        folder: for what a run writes.
        shown: progress, in steps; a comparison counts as one.
    """
    before = {}
    for name in shipped_names():
        before[name] = Trial.of(data, replace(recipe, init=name), folder).loss_now()
        shown.advance()
    after = {}
    for name in sorted(before, key=lambda name: before[name])[:FINALISTS]:
        after[name] = Trial.of(data, replace(recipe, init=name), folder).run(shown)[0]
    return dict(sorted(after.items(), key=lambda item: item[1]))


def timed(data: Dataset, recipe: TrainConfig, folder: Path, shown: Progress) -> tuple[float, float]:
    """Seconds that an example takes in a step of training, and to be answered at all its queries.

    The steps are counted by ``shown``.

    Raises ``ValueError`` where the weights that ``recipe`` starts from are of another architecture.
    """
    trial = Trial.of(data, recipe, folder)
    (_, step_s), rounds = trial.run(shown), []
    for _ in range(2):  # the first one also sets up what later ones find
        started = time.monotonic()
        validate(trial.average, data, replace(trial.config, holdout=SCORED))
        rounds.append((time.monotonic() - started) / SCORED)
    return step_s / recipe.batch, min(rounds)


class Trial(Trainer):
    """Training of ``STEPS`` steps on all of its data, of which only losses and speed count."""

    @classmethod
    def of(cls, data: Dataset, recipe: TrainConfig, folder: Path) -> "Trial":
        """Trial of a recipe, but for its length and what is held out."""
        config = replace(recipe, holdout=0, epochs=STEPS * recipe.batch / len(data), compile="off")
        config = fit_config(config, data)
        return cls(config, data, start_network(config, data), folder, Process(), data.device)

    def run(self, shown: Progress) -> tuple[float, float]:
        """Take all steps, each counted; returns the mean loss of the last ``JUDGED`` and the median seconds of one."""
        times_s = []
        for batch in self.batches():
            started = time.monotonic()
            self.train_step(batch)
            times_s.append(time.monotonic() - started)
            shown.advance()
        assert self.log is not None
        return float(np.mean([row["loss"] for row in self.log.rows[-JUDGED:]])), float(np.median(times_s))

    @torch.no_grad()
    def loss_now(self) -> float:
        """Mean loss of the first examples, without a step."""
        self.network.train()
        config = self.config
        index = torch.arange(min(COMPARED, len(self.data)))
        batch = self.data.batch(index, config.network.points, config.queries, config.augment, Draws.of(config.seed))
        return float(self._loss(batch)[0])


# --- outcome ----------------------------------------------------------------------------------------------------------

GOOD = 0.7
"""mIoU (IoU of an object in one piece) below which an answer is not to be relied upon."""

TITLES = {"search": "search alone", "both": "both: network first, search where unexplained"}


def _comparison(search: Mapping[str, Any], test: Mapping[str, Any]) -> dict[str, Any]:
    """Content of ``metrics.json`` of an object that was trained: the answers, each with its scores, and the best."""
    both = {
        "iou": test["iou"],
        "miou": test["miou"],
        "miou_up_to_symmetry": test["miou_up_to_symmetry"],
        "explained": 1 - test["chosen"]["network"],
        "seconds": test["seconds"],
    }
    method, reason = best_method(search, both)
    best = both if method == "auto" else search
    return {
        "trained": True,
        "method": method,
        "reason": reason,
        "examples": test["examples"],
        "iou": best["iou"],
        "miou": best["miou"],
        "miou_up_to_symmetry": best["miou_up_to_symmetry"],
        "search": search,
        "both": both,
    }


def _show_outcome(
    metrics: Mapping[str, Any], advice: Sequence[str], output: Path, scene: str, frame: str, took_min: float
) -> None:
    """Print the scores, which answer to use, the files, and the command that uses them."""
    print(
        f"\n{metrics['examples']} test views, which training has not seen  {'IoU':>6} {'mIoU':>6} explained  s a frame"
    )
    for name, title in TITLES.items():
        if name in metrics:
            scores = metrics[name]
            figures = f"{format_score(scores['iou'])}  {format_score(scores['miou']):>5} {scores['explained']:>9.0%}"
            print(f"{title:<45} {figures} {scores['seconds']:10.2f}")
    if metrics["miou"] is not None and metrics["miou_up_to_symmetry"] > metrics["miou"] + CLEARLY:
        either = format_score(metrics["miou_up_to_symmetry"])
        print(f"where segments that no frame tells apart count as right either way, the best has an mIoU of {either}")
    print(*([metrics["reason"]] if metrics["trained"] else []), *advice, "", sep="\n")
    if metrics["trained"]:
        print(f"report   {output / 'test' / 'report.html'}")
        print(f"weights  {output / WEIGHTS}")
    print(f"frame    {output / FRAME}: {frame}")
    print(f"this run took {took_min:.1f} min; to find the object in a frame:\n")
    print(f"  {command(output, scene, metrics['trained'], metrics['method'])}")


def command(output: Path, scene: str, is_trained: bool = True, method: str = "auto") -> str:
    """Command that reconstructs the example frame.

    It names the scene of weights where that is not built in, and the folder of an object without weights.
    """
    words = ["mereo", "reconstruct", output / FRAME]
    if is_trained:
        words += ["--weights", output / WEIGHTS, *([] if scene in SCENES else ["--scene", scene])]
    else:
        words += ["--object", scene if scene_of_folder(output) is None else output]
    words += [] if method == "auto" or not is_trained else ["--method", method]
    return shlex.join(map(str, [*words, "--output", output / "result"]))


def _advice_without_training(
    reasons: Sequence[str], files: Sequence[Path], output: Path, config: LearnConfig
) -> list[str]:
    """Why nothing was trained, with the shortcomings of the search alone, and the command that would train it."""
    words = ["mereo", "learn", *files, "--output", output]
    words += [] if config.minutes == 10 else ["--minutes", f"{config.minutes:g}"]
    words += ["--init", config.init] if config.init else []
    words += ["--units", config.units] if config.units else []
    training = shlex.join(map(str, [*words, "--train", "always"]))
    if reasons:
        return [
            f"nothing is trained, as --train is never; the search alone is not good enough: {', '.join(reasons)}.",
            f"A network may help: {training}",
        ]
    return [
        "nothing is trained: the search alone is good enough (every view is explained, mIoU is "
        f"{GOOD_ENOUGH} or more, and {LOWEST} or more in each view).",
        f"A network may still be faster: {training}",
    ]


def advice_after_training(
    metrics: Mapping[str, Any], per_segment: Mapping[str, float | None], minutes: float
) -> list[str]:
    """What to do about scores that will not do; nothing about others."""
    score = metrics["iou"] if metrics["miou"] is None else metrics["miou_up_to_symmetry"]
    if score >= GOOD:
        return []
    weakest = min(per_segment, key=lambda name: per_segment[name] or 0.0)
    return [
        f"warning: {score:.2f} is too low to rely on (below {GOOD}). What helps, in this order:",
        f"  look at the report: is one segment lost ({weakest} is the weakest), or the whole object?",
        f"  more time: the same command with --minutes {3 * minutes:g} and another --output",
        "  narrower deformations, or a camera that stands where yours will (aperture), in the scene file",
    ]


# --- a folder of objects ----------------------------------------------------------------------------------------------


def learn_objects(folder: Path, output: Path, config: LearnConfig, cluster: Cluster | None = None) -> None:
    """Learn each object of a folder into ``output``/NAME, in turn or in tasks of a cluster; one that fails is passed.

    The same call continues what was stopped. All nodes of a cluster must see the files and ``output``.
    Raises ``ValueError`` at the end where an object could not be learnt, before the work as ``list_objects``.
    """
    objects = list_objects(folder.absolute())
    check_place(output, may_be_link=True)
    output.mkdir(parents=True, exist_ok=True)
    work = partial(_learn_in_folder, output.absolute(), config, cluster is not None)
    lines, failed = list[str](), list[str]()
    with closing(spread(work, objects, cluster or 1, lambda _, error: error)) as results:
        for (name, _), result in results:
            if isinstance(result, Exception):
                if os.environ.get("MEREO_TRACEBACK") == "1":
                    raise result
                failed.append(name)
                print(f"mereo: error: {name}: {words_of(result)}", file=sys.stderr, flush=True)
                continue
            scores = f"IoU {format_score(result['iou'])}, mIoU {format_score(result['miou'])}"
            lines.append(f"{output / name}: {scores}, method {result['method']}")
    print("", *lines, sep="\n", flush=True)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(objects)} objects could not be learnt ({', '.join(failed)}), each for the reason "
            "given with it; the others are written: correct them, and repeat the command"
        )


def _learn_in_folder(output: Path, config: LearnConfig, in_task: bool, item: Learnable) -> Any:
    if in_task and not output.is_dir():
        raise FileNotFoundError(f"a node does not see {output}: put objects and --output where all nodes see them")
    name, files = item
    print(f"\n{name}: {', '.join(map(str, files))}", flush=True)
    log = (output / f"{name}.log").open("a", encoding="utf-8") if in_task else nullcontext(sys.stdout)
    with log as out, redirect_stdout(out), redirect_stderr(out if in_task else sys.stderr):
        return learn(files, output / name, config)


# --- the object that is learnt ----------------------------------------------------------------------------------------


def list_objects(folder: Path) -> list[Learnable]:
    """Names and files of objects: each scene file (.yaml, .py) in it, each subfolder with one, or with meshes.

    Raises ``ValueError`` for a folder without objects, with two of one name, or with meshes of its own.
    """
    objects: list[Learnable] = []
    if loose := shapes_in(folder):
        raise ValueError(f"{loose[0]} lies loose in a folder of objects: put the meshes of each into a subfolder")
    for path in sorted(folder.glob("[!.]*")):
        files = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
        if content := [file for file in files if is_yaml(file) or file.suffix == ".py"] or shapes_in(path):
            objects.append((path.name if path.is_dir() else path.stem, content))
    names = [name.casefold() for name, _ in objects]  # some systems ignore case
    if not objects or len({*names}) < len(names):
        raise ValueError(
            f"{folder} has {f'two objects of one name among {names}' if objects else 'no objects'}; each is a scene "
            "file (.yaml, .py) in it, or a subfolder with a scene file, meshes, or a label volume: add or rename some"
        )
    return objects


def place_of_scene(file: Path) -> str:
    """Name of a built-in scene, or the absolute path of a file."""
    return str(file) if names_scene([file]) and not file.suffix else str(file.absolute())


def scene_for(files: Sequence[Path], folder: Path, units: str | None, quiet: bool = False) -> str:
    """Name or file of the scene to learn; for meshes ``folder / SCENE``, which is written where it is missing.

    Raises ``ValueError`` for no files, and for a unit of a scene, which says its own; and as ``write_scene_file`` does.
    """
    if not files:
        raise ValueError("no object is given; name a scene file, or its meshes: mereo learn base.stl arm.stl ...")
    if names_scene(files):
        if units is not None:
            raise ValueError(f"--units is {units}, but {files[0]} says its own: leave it out, or correct the file")
        return str(files[0])
    path = folder / SCENE
    if not path.is_file():
        report = None if quiet else print
        write_scene_file(files, path, units=units, name=files[0].name.split(".")[0], report=report)
        if not quiet:
            print(
                f"wrote {path}; where the object moves in other ways, stop with Ctrl-C, say so in that file "
                "(docs/own-object.md), and learn it again: mereo learn FILE --output ANOTHER"
            )
    return str(path)


def check_object(files: Sequence[Path], units: str | None) -> None:
    """Check an object as ``mereo scene check`` does, and print what that finds; nothing is written.

    Raises ``ValueError`` where something is wrong, with what may repair it.
    """
    with TemporaryDirectory() as folder:
        scene = scene_for(files, Path(folder), units, quiet=True)
        try:
            check_scene(scene)
        except ValueError as error:
            if not is_yaml(scene) or "listed above" not in str(error):
                raise
            named = names_scene(files)
            path = files[0] if named else Path(f"{files[0].stem}.yaml")
            new = "" if named else f"`mereo scene new {shlex.join(map(str, files))} --output {path}` and "
            raise ValueError(
                f"{files[0] if named else 'the object'} has faults, listed above, and nothing is learnt of a wrong "
                f"object: correct them, or let {new}`mereo scene check {path} --repair` try, and learn "
                f"{path.with_name(f'{path.stem}-repaired{path.suffix}')}"
            ) from None
        loaded = load_scene(scene)
    way = deformation(loaded)
    if way < 0.005:
        place = f" in {files[0]}" if names_scene(files) and is_yaml(files[0]) else ""
        print(
            f"warning: {loaded.name} hardly deforms: by {way:.2%} of its length; if it does more than that, widen its "
            f"deformations{place}"
        )


def deformation(scene: Scene) -> float:
    """Mean distance of vertices from their mean place over random states, as a share of the object's longest side."""
    states = np.stack([scene.sample_state(example_rng(0, index)).mesh.merged()[0] for index in range(24)])
    states -= states.mean(axis=1, keepdims=True)
    low, high = scene.rest.bounds
    return float(np.linalg.norm(states - states.mean(axis=0), axis=-1).mean() / (high - low).max())


def write_example_frame(scene: Scene, path: Path) -> str:
    """Write a test view as a PLY file, camera frame; returns what it is, in words with its unit.

    The cloud is in metres, the unit of a file that states none. An object whose size is not known has scene units.
    """
    view = sample_view(scene.for_seed(TEST_SEED_START), GenerateConfig(), example_rng(TEST_SEED_START, 0))
    points = view.depth.to_points().points * (scene.unit_m or 1.0)
    unit = "scene units" if scene.unit_m is None else "metres"
    write_positions_ply(path, points, comment=f"unit: {unit}")
    longest = longest_side(points)
    return f"a test view of {len(points)} points in {unit}; what is seen is {longest:.3g} {unit} long"
