"""``mereo learn`` for a folder of objects: each is learnt into OUTPUT/NAME, one after the other or in tasks."""

import os
import sys
from collections.abc import Mapping
from contextlib import closing, nullcontext, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

from mereo.evaluation.metrics import format_score
from mereo.io.atomic_files import check_place
from mereo.io.errors import words_of
from mereo.io.mesh_formats import MESH_SUFFIXES
from mereo.io.volume_files import is_volume
from mereo.learning.learn import learn
from mereo.scenes.registry import is_yaml
from mereo.workers.spread import Cluster, spread

Learnable = tuple[str, list[Path]]


def list_objects(folder: Path) -> list[Learnable]:
    """Names and files of objects: each scene file (.yaml, .py) in it, each subfolder with one, or with meshes.

    Raises ``ValueError`` for a folder without objects, with two of one name, or with meshes of its own.
    """
    found: list[Learnable] = []
    for path in sorted(folder.glob("[!.]*")):
        files = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
        scenes = [file for file in files if is_yaml(file) or file.suffix == ".py"]
        shapes = [file for file in files if file.suffix.lower() in MESH_SUFFIXES or is_volume(file)]
        if path in shapes:
            raise ValueError(f"{path} lies loose in a folder of objects: put the meshes of each into a subfolder")
        if scenes or shapes:
            found.append((path.stem if path in files else path.name, scenes or shapes))
    names = [name.casefold() for name, _ in found]  # some systems ignore case
    if not found or len({*names}) < len(names):
        raise ValueError(
            f"{folder} has {f'two objects of one name among {names}' if found else 'no objects'}; each is a scene file "
            "(.yaml, .py) in it, or a subfolder with a scene file, meshes, or a label volume: add or rename some"
        )
    return found


def learn_objects(folder: Path, output: Path, settings: Mapping[str, Any], cluster: Cluster | None = None) -> None:
    """Learn each object of a folder into ``output``/NAME with the ``settings`` of ``learn``; one that fails is passed.

    The same call continues what was stopped. All nodes of a cluster must see the files and ``output``.
    Raises ``ValueError`` at the end where an object could not be learnt, before the work as ``list_objects``.
    """
    objects = list_objects(folder.absolute())
    check_place(output, may_be_link=True)
    output.mkdir(parents=True, exist_ok=True)
    learn_one = partial(_learn_one, output.absolute(), settings, cluster is not None)
    lines, failed = list[str](), list[str]()
    with closing(spread(learn_one, objects, cluster or 1, lambda _, error: error)) as results:
        for (name, _), result in results:
            if isinstance(result, Exception):
                if os.environ.get("MEREO_TRACEBACK") == "1":
                    raise result
                failed.append(name)
                print(f"mereo: error: {name}: {words_of(result)}", file=sys.stderr, flush=True)
                continue
            scores = f"IoU {format_score(result['iou'])}, mIoU {format_score(result['miou'])}"
            lines.append(f"{output / name}: {scores}, method {result['method']}")
    print("", *lines, sep="\n", flush=True)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(objects)} objects could not be learnt ({', '.join(failed)}), each for the reason "
            "given with it; the others are written: correct them, and repeat the command"
        )


def _learn_one(output: Path, settings: Mapping[str, Any], in_task: bool, item: Learnable) -> Any:
    if in_task and not output.is_dir():
        raise FileNotFoundError(f"a node does not see {output}: put objects and --output where all nodes see them")
    print(f"\n{item[0]}: {', '.join(map(str, item[1]))}", flush=True)
    log = (output / f"{item[0]}.log").open("a", encoding="utf-8") if in_task else nullcontext(sys.stdout)
    with log as out, redirect_stdout(out), redirect_stderr(out if in_task else sys.stderr):
        return learn(item[1], output / item[0], **settings)
