"""Experiments by name, and how one is run."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast, get_args, runtime_checkable

from rich.console import Console

from mereo.geometry.brief import counted
from mereo.io.atomic_files import check_new_directory
from mereo_experiments.paper.result import Result, write_result
from mereo_experiments.paper.scales import SCALES, ExperimentName, ExperimentScale
from mereo_experiments.paper.store import FINISHED, Store

EXPERIMENTS = get_args(ExperimentName)


@runtime_checkable
class Experiment(Protocol):
    """Module of an experiment: what it answers, what it costs (``SCALES``), on which objects, and how it is run."""

    QUESTION: str
    COST: str
    OBJECTS: tuple[str, ...]
    run: Callable[[Store, ExperimentScale], Result]


def experiment(name: str) -> Experiment:
    """Module of an experiment."""
    return cast(Experiment, import_module(f"mereo_experiments.paper.{name.replace('-', '_')}"))


def results_directory(root: Path, name: str, scale: str, objects: Sequence[str] = ()) -> Path:
    """Folder of an experiment's results at a scale, on these objects or on the scale's own."""
    return root / "results" / "-".join([name, scale, *objects])


def run_experiment(name: str, scale: str, root: Path, workers: int = 1, objects: Sequence[str] = ()) -> Path:
    """Run or finish an experiment; returns the folder of its results, ``ROOT/results/NAME-SCALE``.

    Datasets, runs and scores are kept in ``root`` and shared between experiments: the same command again continues
    where it stopped, and when all is there it only writes the results again. With ``objects``, some of the
    experiment's own instead of those that the scale takes, the folder has their names in its own.

    Raises ``ValueError`` for an unknown name, scale or object, ``FileExistsError`` where that folder holds other
    things.
    """
    if name not in EXPERIMENTS:
        raise ValueError(f"experiment {name!r} is unknown; it must be one of {', '.join(EXPERIMENTS)}: correct it")
    if scale not in SCALES:
        raise ValueError(f"scale {scale!r} is unknown; it must be one of {', '.join(SCALES)}: correct it")
    known = experiment(name).OBJECTS
    if odd := [name for name in objects if name not in known]:
        raise ValueError(f"experiment {name!r} has no object {odd[0]!r}; it has {', '.join(known)}: name some of these")
    budget = replace(SCALES[scale], chosen=tuple(name for name in known if name in objects))
    directory = results_directory(root, name, scale, budget.chosen)
    _check_results(directory)  # before hours of work
    result = experiment(name).run(Store(root, workers), budget)
    if not budget.decides:
        untried = tuple(replace(claim, holds={}) for claim in result.claims)
        result = replace(result, claims=untried, notes=(*result.notes, "It only shows that the experiment runs."))
    write_result(result, directory)
    return directory


def _check_results(directory: Path) -> None:
    """Refuse a folder of results that is not, or not only, of this version; another --output would lose the work."""
    try:
        check_new_directory(directory, force=True)
    except FileExistsError as error:
        folder = str(error).rpartition(": ")[0]
        raise FileExistsError(
            f"{folder}: move it away or delete it, and run the same command again, which keeps the datasets, runs and "
            "scores and writes these results again"
        ) from None


def list_experiments(root: Path) -> None:
    """Print each experiment with what it answers, its costs and those of its results that a folder holds."""
    for name in EXPERIMENTS:
        places = [results_directory(root, name, scale) for scale in SCALES]
        written = [path.parent.name for place in places for path in root.glob(f"results/{place.name}*/results.json")]
        results = ", ".join(sorted(folder.removeprefix(f"{name}-") for folder in written)) or "none"
        print(f"{name}: {experiment(name).QUESTION}\n    {experiment(name).COST}\n    results here: {results}")
    finished = len(list(root.glob(f"runs/*/{FINISHED}")))
    Console(markup=False, emoji=False).print(
        f"\nRun one by: mereo experiment NAME --scale cpu. Results are in {root / 'results'}, each with a table.md. "
        f"{counted(finished, 'finished training')} there: experiments share them and repeat none. Costs are those of "
        "an empty folder; hours of one core as they were measured (docs/experiments.md, entry 10). Scale paper is for "
        "a GPU, on which nobody has timed it; scale smoke takes minutes, and shows only that an experiment runs.",
        highlight=False,
    )
