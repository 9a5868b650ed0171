"""Choose among the candidates of the bank, offline: as the fit does today, and by other energies.

    python benchmarks/bank_choosers.py FOLDER [--choosers NAME ...] [--objects NAME ...] [--conditions NAME ...]

A chooser sees of a frame what a fit could see, never the truth, and names one candidate. Its row is the mean IoU and
mIoU of what it names, by condition; of how many frames its choice is within .01 of the best candidate's mIoU; and how
often it names what the answer was. `best` knows the truth and is the limit of all choosers on these candidates; `from
truth` is where the fit goes from there, and what an energy wants: where that is worse, no search helps.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from bank import FITTED
from bank_views import CONDITIONS, OBJECTS
from jaxtyping import Float

from mereo.fitting.search import HELPS, WHOLE

CLOSE = 0.01
"""Difference in mIoU up to which a choice is as good as the best."""


@dataclass(eq=False)
class Frame:
    """Frame of the bank, with its candidates that were measured.

    Attributes:
        facts: all but the arrays (``bank.packed``).
        rows: the measured candidates.
    """

    path: Path
    facts: dict[str, Any]
    rows: list[dict[str, Any]]

    @classmethod
    def read(cls, path: Path) -> "Frame":
        """Read a frame's file; its arrays are read where they are asked for."""
        with np.load(path, allow_pickle=False) as kept:
            facts = json.loads(kept["facts"].tobytes())
        return cls(path, facts, [row for row in facts["candidates"] if "measured" in row])

    @cached_property
    def arrays(self) -> Mapping[str, np.ndarray]:
        """All arrays."""
        with np.load(self.path, allow_pickle=False) as kept:
            return {name: kept[name] for name in kept.files if name != "facts"}

    @property
    def is_judged(self) -> bool:
        """Whether there are candidates, and a truth to judge them by."""
        return self.facts["is_object"] and len(self.rows) > 0

    def problem(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Facts of the problem in which a candidate was scored."""
        found: dict[str, Any] = self.facts["problems"][row["problem"]]
        return found

    def offsets(self, row: Mapping[str, Any]) -> Float[np.ndarray, " n"]:
        """Signed distances of a candidate's observed points."""
        return self.arrays["offsets"][row["measured"], : self.problem(row)["points"]].astype(np.float64)

    def of_stages(self, stages: Iterable[str]) -> list[int]:
        """Numbers of the candidates from some stages."""
        return [number for number, row in enumerate(self.rows) if row["stage"] in stages]

    @cached_property
    def miou(self) -> Float[np.ndarray, " c"]:
        """True mIoU of each candidate."""
        return np.array([row["miou"] for row in self.rows])


def frames_of(folder: Path, objects: Sequence[str], conditions: Sequence[str]) -> Iterator[Frame]:
    """Read the frames of a bank."""
    for name in objects:
        for path in sorted((folder / name).glob("*.npz")):
            if path.stem.rpartition("-")[0] in conditions:
                yield Frame.read(path)


# --- choosers ---------------------------------------------------------------------------------------------------------

Chooser = Callable[[Frame], int | None]
"""Names a candidate of a frame, by its number; None where it has none."""


def best(frame: Frame) -> int | None:
    """The candidate of the greatest true mIoU."""
    stages = (*FITTED, "settled", "rest", "draws", "draws settled")
    return max(frame.of_stages(stages), key=lambda number: frame.miou[number], default=None)


def from_truth(frame: Frame) -> int | None:
    """Of the fits that start from the truth, in each problem, that of the least misfit in the answer's own problem."""
    starts = frame.of_stages(["from truth"])
    given = answered(frame)
    own = [] if given is None else same(frame, starts, given)
    return least(frame, own or starts) if starts else None


def answered(frame: Frame) -> int | None:
    """What the answer was."""
    return next((number for number, row in enumerate(frame.rows) if row["chosen"]), None)


def least(frame: Frame, numbers: Sequence[int], handicap: Callable[[dict[str, Any]], float] = lambda row: 0.0) -> int:
    """The candidate of the least misfit."""
    return min(numbers, key=lambda number: frame.rows[number]["total"] + handicap(frame.rows[number]))


def today(frame: Frame) -> int | None:
    """The fit's own rules (``search.search``, ``modes.resting``, ``register.is_drawn``), from the terms alone."""
    rows = frame.rows
    problems = frame.facts["problems"]
    fits = [n for n in frame.of_stages(FITTED) if frame.problem(rows[n])["modes"] == problems[0]["modes"]]
    given = [n for n in fits if rows[n]["stage"] != "heavier"]
    if not given:
        return None
    if frame.problem(rows[given[-1]])["noisy"]:  # by every point, in a problem of its own
        given = same(frame, given, given[-1])
    is_open = len({frame.problem(rows[n])["other_lines"] for n in given}) > 1

    def handicap(row: dict[str, Any]) -> float:
        return WHOLE if is_open and frame.problem(row)["other_lines"] == "unknown" else 0.0

    chosen = least(frame, given, handicap)
    heavier = frame.of_stages(["heavier"])
    if not rows[chosen]["explains"] and heavier and rows[heavier[-1]]["cloud"] < HELPS * rows[chosen]["cloud"]:
        chosen = heavier[-1]
    # of the last problem, in which each step that was tried is a candidate
    settled, rest = (
        [least(frame, same(frame, numbers, numbers[-1]))] if numbers else []
        for numbers in (frame.of_stages([stage]) for stage in ("settled", "rest"))
    )
    chosen = [chosen, *settled][-1]
    is_rigid = problems[0]["modes"] == 0
    if rest and (is_rigid or rows[rest[0]]["total"] - rows[chosen]["total"] < rows[chosen]["narrowing"]):
        chosen = rest[0]
    drawn = frame.facts["drawn"]
    draws = frame.of_stages(["draws"])
    if drawn is not None and draws:
        number = min(draws, key=lambda n: abs(rows[n]["total"] - drawn["misfit"]))
        ends = frame.of_stages(["draws settled"])
        chosen = [number, *ends][-1] if drawn["taken"] else chosen
    return chosen


def same(frame: Frame, numbers: Sequence[int], number: int) -> list[int]:
    """Candidates of the same problem."""
    return [n for n in numbers if frame.rows[n]["problem"] == frame.rows[number]["problem"]]


CHOOSERS: dict[str, Chooser] = {
    "from truth": from_truth,
    "best": best,
    "answered": answered,
    "today": today,
}


# --- the table --------------------------------------------------------------------------------------------------------


@dataclass
class Score:
    """What a chooser named in a frame."""

    iou: float
    miou: float
    lost: float
    is_answered: bool


def score(frame: Frame, chooser: Chooser) -> Score | None:
    """Score of a chooser in a frame; None where it names nothing."""
    number = chooser(frame)
    limit = best(frame)
    if number is None or limit is None:
        return None
    lost = float(frame.miou[limit] - frame.miou[number])
    return Score(frame.rows[number]["iou"], frame.rows[number]["miou"], lost, frame.rows[number]["chosen"])


def table(frames: Sequence[Frame], choosers: Mapping[str, Chooser], by: str) -> Iterator[str]:
    """Lines of the table: a row for each chooser and group of frames."""
    yield f"| {by} | chooser | frames | IoU / mIoU | within {CLOSE:g} of the best | as answered |"
    yield "|---|---|---|---|---|---|"
    groups = {"all": frames} | {
        key: [frame for frame in frames if frame.facts[by] == key]
        for key in dict.fromkeys(frame.facts[by] for frame in frames)
    }
    for key, some in groups.items():
        for name, chooser in choosers.items():
            scores = [found for frame in some if (found := score(frame, chooser)) is not None]
            if scores:
                iou, miou = (np.mean([getattr(each, what) for each in scores]) for what in ("iou", "miou"))
                close = np.mean([each.lost <= CLOSE for each in scores])
                alike = np.mean([each.is_answered for each in scores])
                yield f"| {key} | {name} | {len(scores)} | {iou:.3f} / {miou:.3f} | {close:.0%} | {alike:.0%} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--choosers", nargs="+", default=list(CHOOSERS), choices=list(CHOOSERS))
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--by", default="condition", choices=["condition", "object"])
    given = parser.parse_args()
    frames = [frame for frame in frames_of(given.folder, given.objects, given.conditions) if frame.is_judged]
    chosen = {name: CHOOSERS[name] for name in given.choosers}
    print("\n".join(table(frames, chosen, given.by)))


if __name__ == "__main__":
    main()
