"""Record of a training run: metrics.csv; curves.png and TensorBoard events where their extras are installed."""

import csv
import io
import math
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal

from mereo.io.atomic_files import atomic_file, write_file
from mereo.io.extras import CURE, has_plots, pyplot

FIELDS = ("step", "rate", "loss", "ce", "l1", "cd", "align", "rest", "code", "val_iou", "val_miou")
SENSOR_FIELDS = ("sensor_iou", "sensor_miou")
"""Scores that runs on datasets with further observations have besides: of these."""

TABLE, CURVES = "metrics.csv", "curves.png"
Row = dict[str, float]


class MetricsLog:
    """Record of a training run: one row per step in memory; ``write`` puts all of them on disk.

    Rows up to the checkpoint are read back when a run continues, so the file equals that of an uninterrupted run.
    """

    def __init__(self, run_dir: Path, sensors: bool = False) -> None:
        self.run_dir = run_dir
        self.fields = FIELDS + (SENSOR_FIELDS if sensors else ())
        self.rows: list[Row] = []
        self.board: Any = None
        with suppress(ImportError):  # the extra `track`
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(str(run_dir / "tensorboard"))
        self.draws = has_plots()
        if not self.draws:
            _say_left_out()

    def add_step(self, step: int, rate: float, losses: dict[str, float]) -> None:
        """Add the row of a step; ``losses`` are the total under "loss" and its terms."""
        self.rows.append({"step": step, "rate": rate, **losses})
        self._to_board(self.rows[-1])

    def add_validation(self, step: int, iou: float, miou: float, of: Literal["val", "sensor"] = "val") -> None:
        """Add scores of the state after ``step`` to the row of that step; an undefined mIoU (NaN) is left out."""
        both = ((f"{of}_iou", iou), (f"{of}_miou", miou))
        scores = {name: value for name, value in both if not math.isnan(value)}
        if not self.rows or self.rows[-1]["step"] != step:  # the file with the row of that step was lost
            self.rows.append({"step": step})
        self.rows[-1] |= scores
        self._to_board({"step": step, **scores})

    def _to_board(self, row: Row) -> None:
        if self.board is not None:
            for name, value in row.items():
                self.board.add_scalar(name, value, int(row["step"]))

    def summary(self) -> str:
        """Latest numbers in one line."""
        latest = self.rows[-1] if self.rows else {}
        shown = {k: v for k, v in latest.items() if k not in ("step", "rate")}
        return "  ".join(f"{name} {value:.4f}" for name, value in shown.items())

    def write(self) -> None:
        """Write metrics.csv, and curves.png where it can be drawn, each atomically."""
        text = io.StringIO()
        writer = csv.DictWriter(text, self.fields, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: int(v) if k == "step" else repr(v) for k, v in row.items()} for row in self.rows)
        write_file(self.run_dir / TABLE, text.getvalue())
        if self.draws:
            with atomic_file(self.run_dir / CURVES) as temporary:
                draw_curves(self.rows, temporary)

    def is_written(self, step: int) -> bool:
        """Whether the rows that were read back end with ``step``, and their curves are there or cannot be drawn."""
        drawn = (self.run_dir / CURVES).is_file() or not self.draws
        return bool(self.rows) and self.rows[-1]["step"] == step and drawn

    def read_until(self, step: int) -> None:
        """Take up the rows of the steps that the checkpoint includes; ``ValueError`` where they cannot be read."""
        path = self.run_dir / TABLE
        if not path.is_file():
            return
        try:
            with path.open(newline="") as file:
                rows = [{k: float(v) for k, v in row.items() if v != ""} for row in csv.DictReader(file)]
            self.rows = [row for row in rows if row["step"] <= step]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not the table of a run ({error}); delete it to go on without it") from None


@cache
def _say_left_out() -> None:
    """Once for a process, which may train many networks."""
    print(f"{CURVES} is left out, for matplotlib, which draws it, {CURE}", flush=True)


def draw_curves(rows: list[Row], path: Path) -> None:
    """Draw loss terms (running median, logarithmic) and validation scores against the step."""
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for name in ("loss", "ce", "l1"):
        points = [(row["step"], row[name]) for row in rows if row.get(name, 0) > 0]
        if points:
            steps, values = zip(*points, strict=True)
            window = max(1, len(values) // 100)
            smooth = [sorted(values[i : i + window])[window // 2] for i in range(len(values) - window + 1)]
            left.plot(steps[window - 1 :], smooth, label=name)
    left.set(yscale="log", xlabel="step", title="training loss (running median)")
    if left.lines:
        left.legend()
    scores = {"val_iou": "IoU", "val_miou": "mIoU", "sensor_iou": "IoU, sensors", "sensor_miou": "mIoU, sensors"}
    for name, label in scores.items():
        points = [(row["step"], row[name]) for row in rows if name in row]
        if points:
            right.plot(*zip(*points, strict=True), marker=".", label=label)
            right.annotate(f"{points[-1][1]:.3f}", points[-1])
    right.set(xlabel="step", ylim=(0, 1), title="held-out queries")
    if right.lines:
        right.legend()
    figure.savefig(path, dpi=110, format="png")
    plt.close(figure)
