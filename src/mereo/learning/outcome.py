"""The end of learning in words: scores, what to use, whether that will do, and the command for it."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mereo.evaluation.metrics import format_score
from mereo.learning.example_frame import FRAME
from mereo.learning.object_files import scene_of_folder
from mereo.learning.training_choice import GOOD_ENOUGH, LOWEST, best_method
from mereo.models.weights_place import WEIGHTS
from mereo.scenes.scene import SCENES

GOOD = 0.7
"""mIoU (IoU of an object in one piece) below which an answer is not to be relied upon."""

TITLES = {"search": "search alone", "network": "network alone", "both": "both: network first, search where unexplained"}


def comparison(search: Mapping[str, Any], test: Mapping[str, Any]) -> dict[str, Any]:
    """Content of ``metrics.json`` of an object that was trained: the answers, each with its scores, and the best.

    Args:
        search: summary of the search alone, on the views of ``test``.
        test: metrics of the weights.
    """
    slowest = next(test[name] for name in ("full", "modes", "network") if name in test)
    both = {
        "iou": test["iou"],
        "miou": test["miou"],
        "explained": 1 - test["chosen"]["network"],
        "seconds": test.get("seconds") or slowest["seconds"],  # files of older versions have no seconds of their own
    }
    network = {name: test["network"][name] for name in ("iou", "miou", "seconds")}
    table = {"search": search, "network": network, "both": both}
    method, reason = best_method(table)
    best = table["both" if method == "auto" else method]
    return {
        "trained": True,
        "method": method,
        "reason": reason,
        "examples": test["examples"],
        "iou": best["iou"],
        "miou": best["miou"],
        **table,
    }


def show_outcome(
    metrics: Mapping[str, Any], advice: Sequence[str], output: Path, scene: str, frame: str, took_min: float
) -> None:
    """Print the scores, which answer to use, the files, and the command that uses them.

    Args:
        metrics: content of ``metrics.json``.
        advice: lines on what the scores mean.
        output: the folder of what was learnt.
        scene: its name or file.
        frame: what the example frame is.
        took_min: minutes of this run of the command.
    """
    print(
        f"\n{metrics['examples']} test views, which training has not seen  {'IoU':>6} {'mIoU':>6} explained  s a frame"
    )
    for name, title in TITLES.items():
        if name in metrics:
            print(_row(title, metrics[name]))
    if metrics["trained"]:
        print(metrics["reason"])
    for line in advice:
        print(line)
    print()
    if metrics["trained"]:
        print(f"report   {output / 'test' / 'report.html'}")
        print(f"weights  {output / WEIGHTS}")
    print(f"frame    {output / FRAME}: {frame}")
    print(f"this run took {took_min:.1f} min; to find the object in a frame:\n")
    print(f"  {command(output, scene, metrics['trained'], metrics['method'])}")


def _row(title: str, scores: Mapping[str, Any]) -> str:
    explained = f"{scores['explained']:.0%}" if "explained" in scores else "-"
    return f"{title:<45} {format_score(scores['iou'])}  {format_score(scores['miou']):>5} {explained:>9} " + (
        f"{scores['seconds']:10.2f}"
    )


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


def repeated_command(files: Sequence[Path], output: Path, minutes: float, init: str, units: str | None) -> str:
    """Command that goes on in the folder with training."""
    words = ["mereo", "learn", *files, "--output", output]
    words += [] if minutes == 10 else ["--minutes", f"{minutes:g}"]
    words += ["--init", init] if init else []
    words += ["--units", units] if units else []
    return shlex.join(map(str, [*words, "--train", "always"]))


def advice_without_training(reasons: Sequence[str], training: str) -> list[str]:
    """Why nothing was trained, and what would train it.

    Args:
        reasons: shortcomings of the search alone.
        training: command that trains.
    """
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
    score = metrics["iou"] if metrics["miou"] is None else metrics["miou"]
    if score >= GOOD:
        return []
    weakest = min(per_segment, key=lambda name: per_segment[name] or 0.0)
    return [
        f"warning: {score:.2f} is too low to rely on (below {GOOD}). What helps, in this order:",
        f"  look at the report: is one segment lost ({weakest} is the weakest), or the whole object?",
        f"  more time: the same command with --minutes {3 * minutes:g} and another --output",
        "  narrower deformations, or a camera that stands where yours will (aperture), in the scene file",
    ]
