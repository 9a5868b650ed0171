"""Which of the fit's numbers matter: each is doubled, and the answers are scored.

    python benchmarks/sensitivity.py [OBJECT ...] [--views N] [--clean] [--seed S] [--output FILE]

Numbers are those of the constants and defaults of ``mereo.fitting`` and of what it reads of a frame (``FILES``). One is
doubled, or, where it is a share between .5 and 1, its distance from 1 halved, in a copy of the source, in which N views
of each object (training seeds) are answered from the network, where there is one: whole ones by the paper's camera, and
unless ``--clean`` is given, as many by simulated cameras, and as many of which a tool hides 30 %, by a search without
the network (``recognition.own_views``). A number matters if the mean mIoU over the views changes by .002 or more. To
save time, groups of numbers change together and are halved where the group matters, and a group is given up at the
first view that alone would change the mean by that much.
Objects are shipped ones, or files of scenes, which are always searched for.
Rows are kept in FILE, so that a run that was cut off goes on where it was.
"""

import argparse
import ast
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree, ignore_patterns
from tempfile import TemporaryDirectory

import numpy as np
from recognition import own_views, sized

import mereo
from mereo.api.objects import load_object
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.geometry.metrics import TruthGrid, grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.reconstruction.observation import Observation
from mereo.scenes.registry import load_scene

SOURCE = Path(mereo.__file__).parent

FILES = (
    *("fitting/config.py", "fitting/modes.py", "fitting/search.py", "fitting/problem/*.py", "fitting/draws/*.py"),
    *("fitting/registration/answer.py", "fitting/registration/answer_frame.py", "reconstruction/observation.py"),
    "geometry/surface_patches.py",
)

NO_MEASURE = ("STATES_SEED", "HELD", "POSE", "BLOCK", "TrackConfig", "Answer.resolution")
"""What is no tuned number (a seed, a layout, a unit, a size of a block of work), an option, or of sequences alone."""

LEAST_CHANGE = 0.002
"""Change of the mean mIoU from which a number matters."""

CELLS, TOGETHER = 50, 16
"""Cells of the truth along each axis; numbers of the first groups."""


@dataclass(frozen=True)
class Number:
    """A number in the source: its file, the name it belongs to, and where its text is."""

    path: str
    name: str
    line: int
    start: int
    end: int
    value: float

    @property
    def changed(self) -> str:
        if isinstance(self.value, float) and 0.5 < self.value < 1:
            return repr((1 + self.value) / 2)
        return repr(2 * self.value)

    def __str__(self) -> str:
        return f"{self.path.removesuffix('.py')}:{self.name} {self.value:g} -> {float(self.changed):g}"


def numbers_of(path: Path) -> Iterator[Number]:
    """Numbers in constants and in defaults of fields, from the top of a file to its end."""
    tree = ast.parse(path.read_text("utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name not in NO_MEASURE]
    nested = [(f"{each.name}.", inner) for each in classes for inner in each.body]
    for prefix, node in sorted([("", each) for each in tree.body] + nested, key=lambda pair: pair[1].lineno):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        name = prefix + ast.unparse(target).strip("()")
        if name in NO_MEASURE:
            continue
        constants = [each for each in ast.walk(node.value) if isinstance(each, ast.Constant)]
        for index, each in enumerate(sorted(constants, key=lambda each: (each.lineno, each.col_offset))):
            if isinstance(each.value, int | float) and not isinstance(each.value, bool) and each.value:
                assert each.end_col_offset is not None
                where = str(path.relative_to(SOURCE))
                nth = f"{name}[{index}]" if len(constants) > 1 else name
                yield Number(where, nth, each.lineno, each.col_offset, each.end_col_offset, each.value)


# --- a child answers in a copy of the source --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Frame:
    name: str
    seen: Observation
    truth: TruthGrid
    names: int


def make_frames(objects: Sequence[str], views: int, seed: int, clean: bool) -> list[Frame]:
    frames = []
    for name in objects:
        for kind, view, seen in own_views(load_scene(name), views, seed):
            if kind == "clean" or not clean:
                truth = truth_grid(view.mesh, CELLS)
                frames.append(Frame(name, seen, truth, len(view.mesh.names)))
    return frames


def answer_frames(path: Path) -> None:
    """Print the score of each frame of a file as soon as it is answered."""
    import torch

    torch.set_num_threads(1)
    frames = pickle.loads(path.read_bytes())
    registrars = {}
    for frame in frames:
        if frame.name not in registrars:
            thing = load_object(frame.name, device="cpu", precision="float32")
            registrar = thing.registrar()
            assert registrar is not None
            registrars[frame.name] = thing.network, sized(registrar)
        score = 0.0
        start = time.process_time()
        try:
            answer = answer_frame(frame.seen, *registrars[frame.name])
            assert answer.registration is not None
            labels = labels_on(answer.registration.mesh, frame.truth.grid)
            score = intersection_over_union(grid_confusion(frame.truth, labels, frame.names)).miou
        except (ValueError, ArithmeticError, IndexError, AssertionError, RuntimeError):
            pass  # a fit that fails is an answer that is wrong
        print(json.dumps([score, time.process_time() - start]), flush=True)


def scores_with(numbers: Sequence[Number], frames: Path) -> Iterator[tuple[float, float]]:
    """Scores and seconds of the frames, one after the other, with some numbers changed."""
    with TemporaryDirectory() as folder:
        package = Path(folder) / "mereo"
        copytree(SOURCE, package, ignore=ignore_patterns("__pycache__", "states", "frames"))
        for name in ("states", "frames"):
            (package / name).symlink_to(SOURCE / name)
        for number in reversed(numbers):  # the last in a line first, so that the others stay where they are
            path = package / number.path
            lines = path.read_text("utf-8").splitlines(keepends=True)
            line = lines[number.line - 1]
            lines[number.line - 1] = line[: number.start] + number.changed + line[number.end :]
            path.write_text("".join(lines), "utf-8")
        environment = {**os.environ, "PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, __file__, "--answer", str(frames)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as child:
            assert child.stdout is not None
            try:
                for line in child.stdout:
                    score, seconds = json.loads(line)
                    yield score, seconds
            finally:
                child.kill()


# --- groups -----------------------------------------------------------------------------------------------------------


@dataclass
class Study:
    frames: Path
    usual: list[float]
    output: Path

    def run(self, numbers: Sequence[Number]) -> None:
        """Find the numbers of a group that matter."""
        kept = json.loads(self.output.read_text("utf-8")) if self.output.exists() else {}
        numbers = [number for number in numbers if str(number) not in kept]
        if not numbers:
            return
        changes = self.changes(numbers)
        mean = sum(changes) / len(self.usual)
        matters = len(changes) < len(self.usual) or abs(mean) >= LEAST_CHANGE or self.is_enough(changes[-1])
        if matters and len(numbers) > 1:
            half = len(numbers) // 2
            self.run(numbers[:half])
            self.run(numbers[half:])
            return
        for number in numbers:
            largest = max([0.0, *changes], key=abs)
            facts = {"change": round(mean, 5), "views": len(changes), "most": round(largest, 4)}
            kept[str(number)] = {"matters": matters, **facts}
            print(
                f"{'matters' if matters else 'no effect':9} {number!s:60}  {mean:+.4f}, a view {largest:+.3f}",
                flush=True,
            )
        self.output.write_text(json.dumps(kept, indent=1), "utf-8")

    def changes(self, numbers: Sequence[Number]) -> list[float]:
        """Changes of the views' scores, up to the first that is too great by itself; fewer where a child dies."""
        changes: list[float] = []
        for usual, (score, _) in zip(self.usual, scores_with(numbers, self.frames), strict=False):
            changes.append(score - usual)
            if self.is_enough(changes[-1]):
                break
        return changes

    def is_enough(self, change: float) -> bool:
        """Whether the change of a single view changes the mean by as much as matters."""
        return abs(change) >= LEAST_CHANGE * len(self.usual)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="*", default=["tumor", "liver", "robot", "rope"])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--clean", action="store_true", help="whole views by the paper's camera alone")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--output", type=Path, default=Path("sensitivity.json"))
    parser.add_argument("--answer", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer is not None:
        answer_frames(options.answer)
        return
    numbers = [each for pattern in FILES for path in sorted(SOURCE.glob(pattern)) for each in numbers_of(path)]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frames.pickle"
        frames = make_frames(options.objects, options.views, options.seed, options.clean)
        path.write_bytes(pickle.dumps(frames))
        usual = list(scores_with([], path))
        order = sorted(range(len(frames)), key=lambda index: usual[index][1])
        path.write_bytes(pickle.dumps([frames[index] for index in order]))
        scores = [usual[index][0] for index in order]
        print(f"{len(numbers)} numbers, {len(scores)} views, mean mIoU {np.mean(scores):.4f}", flush=True)
        print(" ".join(f"{frames[index].name} {usual[index][0]:.3f} {usual[index][1]:.1f} s" for index in order))
        study = Study(path, scores, options.output)
        for first in range(0, len(numbers), TOGETHER):
            study.run(numbers[first : first + TOGETHER])


if __name__ == "__main__":
    main()
