"""``mereo learn`` for a folder of objects: one trial for each, here one after the other or as tasks of a cluster.

folder -objects_in-> names and files -learn_objects-> OUTPUT/NAME for each, and a table of the scores
"""

import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mereo.evaluation.metrics import format_score
from mereo.io.atomic_files import check_place
from mereo.io.foreseen import words_of
from mereo.io.mesh_formats import MESH_SUFFIXES
from mereo.io.output_folders import claim_directory
from mereo.io.progress import duration
from mereo.io.volume_files import is_volume
from mereo.learning.learn import learn
from mereo.learning.search_stage import TrainChoice
from mereo.scenes.registry import is_yaml
from mereo.workers.config import Cluster
from mereo.workers.spread import spread

OBJECTS = "objects.json"
"""File of the output that says which folder's objects are learnt, and how."""

Learnable = tuple[str, tuple[Path, ...]]
"""Object's name, and its files as ``learn`` takes them."""


@dataclass(frozen=True)
class Trial:
    """What became of one object.

    Attributes:
        name: its own.
        metrics: scores as its metrics.json has them; None where it could not be learnt.
        reason: why not, in a sentence.
        seconds: that its trial took.
    """

    name: str
    metrics: dict[str, Any] | None
    reason: str = ""
    seconds: float = 0.0


def is_folder_of_objects(files: Sequence[Path]) -> bool:
    """Whether the files are not one object but a folder of several."""
    return len(files) == 1 and files[0].is_dir()


def objects_in(folder: Path) -> list[Learnable]:
    """Objects of a folder by name: each scene file (.yaml, .py) in it, and each subfolder.

    A subfolder is the object of its scene file, where it has one, and else of its meshes, one for each segment, or of
    its label volume. Hidden entries, and subfolders with none of these, are no objects.

    Raises ``ValueError`` where there are none, where meshes lie in the folder itself, where a subfolder has several
    scene files, and where two objects have one name.
    """
    found: list[Learnable] = []
    for path in _visible(folder):
        if path.is_dir():
            files = _files_of(path)
            found += [(path.name, files)] if files else []
        elif _is_scene(path):
            found.append((path.stem, (path,)))
        elif _is_shape(path):
            raise ValueError(
                f"{path} lies loose in a folder of objects, so it is not clear whose it is: put the meshes of each "
                f"object into a subfolder, or name those of one object (mereo learn {folder}/*{path.suffix} ...)"
            )
    if not found:
        raise ValueError(
            f"{folder} has no objects; each is a scene file (.yaml, .py) in it, or a subfolder with a scene file, "
            "meshes, or a label volume: add some"
        )
    twice, count = Counter(name.casefold() for name, _ in found).most_common(1)[0]  # some systems ignore case
    if count > 1:
        raise ValueError(f"{folder} has {count} objects named {twice!r}, which need folders of their own: rename one")
    return found


def _visible(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def _is_scene(path: Path) -> bool:
    return is_yaml(path) or path.suffix == ".py"


def _is_shape(path: Path) -> bool:
    return path.suffix.lower() in MESH_SUFFIXES or is_volume(path)


def _files_of(folder: Path) -> tuple[Path, ...]:
    """Files of the object that a subfolder holds; none where it holds none."""
    files = [path for path in _visible(folder) if path.is_file()]
    scenes = tuple(path for path in files if _is_scene(path))
    if len(scenes) > 1:
        raise ValueError(
            f"{folder} has {len(scenes)} scene files, {scenes[0].name} and {scenes[1].name}; a subfolder is one "
            "object: leave one, or put each into a folder of its own"
        )
    return scenes or tuple(path for path in files if _is_shape(path))


def learn_objects(
    folder: Path,
    output: Path,
    *,
    minutes: float = 10.0,
    init: str = "",
    units: str | None = None,
    workers: int = 1,
    train: TrainChoice = "auto",
    cluster: Cluster | None = None,
) -> list[Trial]:
    """Learn each object of a folder into ``output``/NAME, and print a table; one that fails is said and passed over.

    The same call continues what was stopped, and learns objects that were added since.

    Args:
        folder: as ``objects_in`` takes it.
        output: folder to create. What a task prints is in ``output``/NAME.log.
        minutes: the budget of each object.
        init: weights to start from; empty compares the shipped ones.
        units: of the meshes; guessed where not given.
        workers: processes that make examples of an object.
        train: when to train an object, as ``learn`` takes it.
        cluster: where each object is a task, whose CPUs are its workers. All nodes must see the files and ``output``
            under the same paths.

    Raises ``ValueError`` at the end where an object could not be learnt; before the work as ``objects_in`` does, and
    for other arguments than the output was begun with.
    """
    found = objects_in(folder)
    settings = {"folder": str(folder.absolute()), "minutes": minutes, "init": init, "units": units}
    _claim(output, settings)
    absolute = [(name, tuple(file.absolute() for file in files)) for name, files in found]
    trial = _Learning(
        output.absolute(), minutes, init, units, cluster.cpus if cluster else workers, train, cluster is not None
    )
    trials: dict[str, Trial] = {}
    started = time.monotonic()
    with closing(spread(trial, absolute, cluster=cluster, lost=_lost)) as done:
        for (name, _), one in done:
            trials[name] = one
            print(f"\n[{len(trials)} of {len(found)}] {name} {_outcome(one)}", flush=True)
            if one.metrics is None:
                print(f"mereo: error: {name}: {one.reason}", file=sys.stderr, flush=True)
    ordered = [trials[name] for name, _ in found]
    _show(ordered, output, time.monotonic() - started)
    failed = [one.name for one in ordered if one.metrics is None]
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(found)} objects could not be learnt ({', '.join(failed)}), each for the reason "
            "given with it; the others are written: correct them, and repeat the command"
        )
    return ordered


def _claim(output: Path, settings: dict[str, Any]) -> None:
    check_place(output, may_be_link=True)
    before = claim_directory(output, OBJECTS, settings, "what is learnt of a folder")
    for name, value in settings.items():
        if before is not None and before.get(name) != value:
            raise ValueError(
                f"{output} was begun with {name} = {before.get(name)!r}, not {value!r}; it is continued with equal "
                "arguments: repeat those, or choose another --output"
            )


@dataclass(frozen=True)
class _Learning:
    """Learns one object at a time; ``remote`` in a task, whose words go into a file."""

    output: Path
    minutes: float
    init: str
    units: str | None
    workers: int
    train: TrainChoice
    remote: bool

    def __call__(self, item: Learnable, cancelled: Callable[[], bool]) -> Trial:
        """Trial of an object; nothing asks whether to give up, as what is stopped is continued."""
        name, files = item
        started = time.monotonic()
        try:
            with ExitStack() as stack:
                if self.remote:
                    self._check_shared(files)
                    log = stack.enter_context((self.output / f"{name}.log").open("a", encoding="utf-8"))
                    stack.enter_context(redirect_stdout(log))
                    stack.enter_context(redirect_stderr(log))
                else:
                    print(f"\n{name}: {', '.join(map(str, files))}", flush=True)
                metrics = learn(
                    files,
                    self.output / name,
                    minutes=self.minutes,
                    init=self.init,
                    units=self.units,
                    workers=self.workers,
                    train=self.train,
                )
        except Exception as error:
            if os.environ.get("MEREO_TRACEBACK") == "1":
                raise
            return Trial(name, None, words_of(error), time.monotonic() - started)
        return Trial(name, metrics, seconds=time.monotonic() - started)

    def _check_shared(self, files: Sequence[Path]) -> None:
        """Raise where this machine does not see the files."""
        for path in (self.output / OBJECTS, *files):
            if not path.is_file():
                raise FileNotFoundError(
                    f"node {socket.gethostname()} does not see {path}; objects and --output must lie where all nodes "
                    "see them under the same path: put both on a file system that they share"
                )


def _outcome(trial: Trial) -> str:
    """Phrase on what became of an object."""
    if trial.metrics is None:
        return "failed"
    return f"{'trained' if trial.metrics['trained'] else 'scored without training'} in {duration(trial.seconds)}"


def _lost(item: Learnable, error: ChildProcessError) -> Trial:
    """Trial of an object whose task was killed again and again."""
    return Trial(item[0], None, str(error))


def _show(trials: Sequence[Trial], output: Path, seconds: float) -> None:
    """Table of all objects."""
    print()
    table = Table(title=f"{len(trials)} objects in {duration(seconds)}, results in {output}/NAME", title_justify="left")
    table.add_column("object", overflow="fold")
    table.add_column("use")
    for column in ("IoU", "mIoU", "took"):
        table.add_column(column, justify="right")
    for one in trials:
        scores = (
            ("", "", "", "failed")
            if one.metrics is None
            else (
                "both" if one.metrics["method"] == "auto" else one.metrics["method"],
                format_score(one.metrics["iou"]),
                format_score(one.metrics["miou"]),
                duration(one.seconds),
            )
        )
        table.add_row(one.name, *scores)
    Console(markup=False, emoji=False).print(table)
