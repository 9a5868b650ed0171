"""Scores of all objects under simulated cameras as the rows of docs/results.md, and how many bad answers say nothing.

    python benchmarks/sensor_scores.py FOLDER [--commands] [--views N]

FOLDER has what `mereo evaluate` has written, one folder for each object and camera (`rope-time-of-flight`); with
``--commands``, the commands that are still to be run are printed instead. Cameras: clean (the network alone, for its
tenth percentile), structured-light, time-of-flight, and tool: structured light with a tool in front of half of the
views. A bad answer is one below the tenth percentile of the network's own mIoU on clean views.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from mereo.geometry.metrics import format_score
from mereo.models.weights_place import shipped_names

CAMERAS = {
    "clean": "--method network",
    "structured-light": "--sensor structured-light --image-size 192",
    "time-of-flight": "--sensor time-of-flight --image-size 192",
    "tool": "--sensor structured-light --sensor.tool 0.5 --image-size 192",
}
"""Options of `mereo evaluate`, by the camera's name."""

CLEAN_VIEWS = 4
"""How many times as many clean views: the network alone is quick, and a percentile needs them."""

BESIDE = ("tumor",)
"""Objects that are no part of the mean: they are another's."""


def commands(folder: Path, views: int) -> list[str]:
    """What is still to be run."""
    return [
        f"mereo evaluate {name} --examples {views * (CLEAN_VIEWS if camera == 'clean' else 1)} {options} "
        f"--output {folder / f'{name}-{camera}'}"
        for camera, options in CAMERAS.items()
        for name in shipped_names()
        if not (folder / f"{name}-{camera}" / "metrics.json").is_file()
    ]


def pair(found: dict[str, Any] | None) -> str:
    """IoU and mIoU; a dash where nothing was measured."""
    return "-" if found is None else f"{format_score(found['iou'])} / {format_score(found['miou'])}"


def mean(tests: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean IoU and mIoU of several tests, and of their networks."""
    result: dict[str, Any] = {key: float(np.mean([test[key] for test in tests])) for key in ("iou", "miou")}
    network = {key: float(np.mean([test["network"][key] for test in tests])) for key in ("iou", "miou")}
    return {**result, "network": network}


def unwarned(test: dict[str, Any], least: float) -> tuple[int, int]:
    """Views whose answer has a mIoU below ``least``, and how many of these are said to be known for sure."""
    bad = [one for one in test["per_example"].values() if one["miou"] < least]
    return len(bad), sum(one.get("known") is True for one in bad)


def main() -> None:
    """Print the commands, or the rows and the warnings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--commands", action="store_true")
    parser.add_argument("--views", type=int, default=8)
    options = parser.parse_args()
    if options.commands:
        print("\n".join(commands(options.folder, options.views)))
        return
    tests = {
        (name, camera): json.loads(path.read_text(encoding="utf-8"))
        for name in shipped_names()
        for camera in CAMERAS
        if (path := options.folder / f"{name}-{camera}" / "metrics.json").is_file()
    }
    cameras = [camera for camera in CAMERAS if camera != "clean"]
    print(f"| input | {' | '.join(f'{camera}: network alone | with registration' for camera in cameras)} |")
    print(f"|---|{'---|---|' * len(cameras)}")
    for name in shipped_names():
        each = [tests.get((name, camera)) for camera in cameras]
        cells = [f"{pair(test and test['network'])} | **{pair(test)}**" for test in each]
        print(f"| {name} | {' | '.join(cells)} |")
    cells = []
    for camera in cameras:
        found = [tests[name, camera] for name in shipped_names() if name not in BESIDE and (name, camera) in tests]
        cells.append(f"{pair(mean(found)['network'])} | **{pair(mean(found))}** ({len(found)})" if found else "- | -")
    print(f"| mean (of how many) | {' | '.join(cells)} |")
    print("\n| bad answers / of these said to be known |", " | ".join(cameras), "|")
    print(f"|---|{'---|' * len(cameras)}")
    for name in shipped_names():
        if (name, "clean") in tests:
            least = tests[name, "clean"]["network"]["miou_tenth"]
            counts = [unwarned(tests[name, one], least) if (name, one) in tests else None for one in cameras]
            shown = " | ".join("-" if count is None else f"{count[0]} / {count[1]}" for count in counts)
            print(f"| {name}, below {least:.3f} | {shown} |")


if __name__ == "__main__":
    main()
