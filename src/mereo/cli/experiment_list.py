"""``mereo experiment list``: which experiments there are, what each answers and costs, and which results are here."""

from pathlib import Path

from rich.console import Console

from mereo.geometry.brief import counted
from mereo_experiments.paper.plan import SEEN_PER_S, Listed, listed


def list_experiments(root: Path) -> None:
    """Print each experiment with what it answers, its costs and those of its results that a folder holds."""
    found, finished = listed(root)
    for one in found:
        print(f"{one.name}: {one.question}\n    {_costs(one)}\n    results here: {', '.join(one.here) or 'none'}")
    Console(markup=False, emoji=False).print(
        f"\nRun one by: mereo experiment NAME --scale cpu. Results are in {root / 'results'}, each with a table.md. "
        f"{counted(finished, 'finished training')} there: experiments share them and repeat none. Costs are those of "
        "an empty folder; hours of one core as they were measured (docs/experiments.md, entry 10). Scale paper is for "
        "a GPU, on which nobody has timed it; scale smoke takes minutes, and shows only that an experiment runs.",
        highlight=False,
    )


def _costs(one: Listed) -> str:
    cpu, paper = one.costs["cpu"], one.costs["paper"]
    hours = cpu.seen / SEEN_PER_S / 3600
    return (
        f"cpu: {counted(cpu.trainings, 'training')}, {hours:.1f} hours; "
        f"paper: {counted(paper.trainings, 'training')}, {paper.seen / 1e6:.0f} million examples shown"
    )
