"""What a user is told at the end of learning: scores, whether they will do, and the command that uses the weights."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mereo.evaluation.metrics import format_score
from mereo.learning.example_frame import FRAME
from mereo.models.weights_place import WEIGHTS
from mereo.scenes.scene import SCENES

GOOD = 0.7
"""mIoU (IoU of an object in one piece) below which an answer is not to be relied upon."""

TITLES = {"network": "network alone", "modes": "modes registered", "full": "modes and draws registered"}


def show_outcome(
    metrics: Mapping[str, Any], output: Path, scene: str, frame: str, minutes: float, took_min: float
) -> None:
    """Print the scores, the report's place and the command that uses the weights.

    Args:
        metrics: of the evaluation.
        output: the folder of what was learnt.
        scene: its name or file.
        frame: what the example frame is.
        minutes: the budget.
        took_min: what this run of the command took.
    """
    print(f"\n{metrics['examples']} test views, which training has not seen    IoU   mIoU  median seconds")
    for name, title in TITLES.items():
        if name in metrics:
            found = metrics[name]
            print(_row(title, found["iou"], found["miou"], f"{found['seconds']:15.2f}"))
    print(_row("the answer you get", metrics["iou"], metrics["miou"]))
    for line in advice(metrics, minutes):
        print(line)
    print(f"\nreport   {output / 'test' / 'report.html'}")
    print(f"weights  {output / WEIGHTS}")
    print(f"frame    {output / FRAME}: {frame}")
    print(f"this run took {took_min:.1f} min; to use the weights:\n")
    print(f"  {command(output, scene)}")


def _row(title: str, iou: float, miou: float | None, seconds: str = "") -> str:
    return f"{title:<44} {format_score(iou)} {format_score(float('nan') if miou is None else miou):>6}{seconds}"


def command(output: Path, scene: str) -> str:
    """Command that reconstructs the example frame; it names the scene where that is not built in."""
    words = ["mereo", "reconstruct", output / FRAME, "--weights", output / WEIGHTS]
    words += [] if scene in SCENES else ["--scene", scene]
    return shlex.join(map(str, [*words, "--output", output / "result"]))


def advice(metrics: Mapping[str, Any], minutes: float) -> list[str]:
    """What to do about scores that will not do; nothing about others."""
    score = metrics["iou"] if metrics["miou"] is None else metrics["miou"]
    if score >= GOOD:
        return []
    weakest = min(metrics["per_segment"], key=lambda name: metrics["per_segment"][name] or 0.0)
    return [
        f"warning: {score:.2f} is too low to rely on (below {GOOD}). What helps, in this order:",
        f"  look at the report: is one segment lost ({weakest} is the weakest), or the whole object?",
        f"  more time: the same command with --minutes {3 * minutes:g} and another --output",
        "  narrower deformations, or a camera that stands where yours will (aperture), in the scene file",
    ]
