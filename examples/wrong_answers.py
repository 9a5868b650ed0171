"""One wrong answer of each kind, with what mereo says of it: the picture of docs/trust.md.

    python examples/wrong_answers.py --output wrong_answers.png

Every column is one frame, made of a built-in object: the truth above, the answer below, both seen from beside the
camera, with the observed points as dark dots; the unit is stated. Views are of test seeds, chosen because their
answers are wrong.
"""

import argparse
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import mereo
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.io.atomic_files import check_file_place
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo.visualization.contact_sheets import INK, Picture, fit_font, save_png
from mereo.visualization.previews import points_on_segments
from mereo.visualization.reconstruction_report import VERDICTS, trust

SIDE, TEXT = 280, 130
"""In pixels: of each picture, and the height of the words below a column."""

BESIDE = ((0.75, 0.2, 0.6), (0.0, -1.0, 0.0))
"""Viewing direction and up: from the left of the camera, so that the hidden side is seen."""


@dataclass(frozen=True, eq=False)
class Case:
    """A frame whose answer is wrong.

    Attributes:
        title: what is wrong.
        name: of the object that is searched for.
        index: of the view.
        seen: the object that the view shows, where it is another one.
        camera: whose errors the view has.
        finder: "weights", or "meshes" for a search without a network.
        change: what happens to the points.
    """

    title: str
    name: str
    index: int
    seen: str | None = None
    camera: Sensor = "paper"
    finder: str = "weights"
    change: Callable[[np.ndarray], np.ndarray] = np.copy

    def draw(self) -> Picture:
        """Column of truth, answer, and what is said of it."""
        scene = load_scene(self.seen or self.name)
        settings = GenerateConfig(sensor=SENSORS[self.camera])
        view = sample_view(scene.for_seed(TEST_SEED_START), settings, example_rng(TEST_SEED_START, self.index))
        points = self.change(view.depth.to_points().points)
        given = self.name if self.finder == "weights" else load_scene(self.name)
        result = mereo.reconstruct(PointCloud(points), given, unit_m=scene.unit_m)
        score = "" if self.seen else scores(view.mesh, result.surfaces)
        verdict = trust(result.to_dict())
        words = [self.title, score, f"{VERDICTS[verdict.level]}: {verdict.why}".replace("\N{NO-BREAK SPACE}", " ")]
        print(" | ".join(words), flush=True)
        pictures = [points_on_segments(points, mesh, [BESIDE], SIDE)[0] for mesh in (view.mesh, result.surfaces)]
        return np.concatenate([*pictures, written(words)])


def scores(truth: SegmentedMesh, answer: SegmentedMesh) -> str:
    grid = truth_grid(truth, 60)
    found = intersection_over_union(grid_confusion(grid, labels_on(answer, grid.grid), len(truth.segments)))
    return f"IoU {found.iou:.2f}, mIoU {found.miou:.2f}"


def written(words: list[str]) -> Picture:
    plate = Image.new("RGB", (SIDE, TEXT), "white")
    pen = ImageDraw.Draw(plate)
    title, score, verdict = words
    for row, text in enumerate((title, score, *textwrap.wrap(verdict, 44))):
        pen.text((SIDE // 2, 14 + 19 * row), text, fill=INK, font=fit_font(13 if row else 17, text, SIDE), anchor="mm")
    return np.asarray(plate)


CASES = (
    Case("a coil, its bend guessed", "rope", 0, finder="meshes"),
    Case("a thin sheet, noisy camera", "sheet", 0, camera="time-of-flight"),
    Case("another object", "bunny", 0, seen="skull"),
    Case("1.35 times its size", "liver", 0, change=lambda points: 1.35 * points),
    Case("half of it cut away", "human", 0, change=lambda points: points[points[:, 1] < np.median(points[:, 1])]),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("wrong_answers.png"))
    output = parser.parse_args().output
    check_file_place(output)
    columns = [case.draw() for case in CASES]
    gap = np.full((len(columns[0]), 12, 3), 255, dtype=np.uint8)
    save_png(output, np.concatenate([part for column in columns for part in (column, gap)][:-1], axis=1))
    print(f"wrote {output}")


if __name__ == "__main__":
    main()
