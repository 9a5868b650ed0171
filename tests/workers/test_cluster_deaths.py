"""A Ray cluster gives the bits of one process: for any number of workers and nodes, and whichever of them dies."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from glob import glob
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import pytest
from angle import write_angle
from browser import until
from folder_contents import contents, read_json
from many_frames import content, frames, loads, run
from numpy.random import default_rng
from toy_data import SMALL
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.models.model import Model
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.workers.spread import Cluster
from mereo_learning import shards
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.scoring import EvaluationConfig

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'mereo[cluster]'")

pytestmark = pytest.mark.slow

__all__ = ["loads"]  # a fixture

EXAMPLES, KILLS = 96, 10


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "SHARD_SIZE", 4)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The dataset as one process makes it: 24 shards."""
    output = tmp_path_factory.mktemp("whole") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "SHARD_SIZE", 4)
        generate(toy_scene(), output, SMALL, examples=EXAMPLES, seed=3)
    return contents(output)


@pytest.fixture
def nodes() -> Iterator[Any]:
    """A head without CPUs and two nodes of one CPU each, all on this machine."""
    from ray.cluster_utils import Cluster as Nodes

    Path("/tmp/ray").mkdir(exist_ok=True)  # where Ray writes the latest cluster's address, wherever its own files are
    with TemporaryDirectory(prefix="ray-", dir="/tmp") as folder:
        head = {"num_cpus": 0, "include_dashboard": False, "temp_dir": folder}
        made = Nodes(initialize_head=True, head_node_args=head)
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made, folder
        ray.shutdown()
        made.shutdown()


def processes(*words: str) -> list[psutil.Process]:
    lines = ((process, " ".join(process.info["cmdline"] or ())) for process in psutil.process_iter(["cmdline", "ppid"]))
    return [process for process, line in lines if all(word in line for word in words)]


def working(place: str) -> list[int]:
    """Workers at a task, of the cluster whose files lie in a folder."""
    nodes = [node.pid for node in processes("raylet", place)]
    return sorted(process.pid for process in processes("ray::_apply") if process.info["ppid"] in nodes)


def folder_of_ray(process: int) -> str:
    """Beginning of the folder in which a process has Ray's files."""
    return f"/tmp/mereo-ray-{process}-"


def has_left(process: int) -> bool:
    """Whether processes or files of Ray stay for long when a process has ended."""
    with suppress(TimeoutError):
        until(lambda: not processes(folder_of_ray(process)), 15)
    return bool(processes(folder_of_ray(process)) or glob(f"{folder_of_ray(process)}*"))


def started(line: str, **options: Any) -> "tuple[subprocess.Popen[str], Any]":
    """A command, as soon as workers of its own cluster are at a task, and these: they may be done a moment later."""
    command = subprocess.Popen([sys.executable, "-m", "mereo", *line.split()], text=True, stderr=-1, **options)
    busy = until(lambda: working(folder_of_ray(command.pid)) or command.poll() is not None, 300)
    return command, busy


@pytest.mark.parametrize("workers", [1, 3])
def test_workers_change_no_bit(workers: int, whole: dict[str, bytes], tmp_path: Path) -> None:
    generate(toy_scene(), tmp_path / "data", SMALL, examples=EXAMPLES, seed=3, workers=workers, ray="local")
    assert contents(tmp_path / "data") == whole
    assert not has_left(os.getpid())


def test_nodes_that_die_lose_nothing(nodes: tuple[Any, str], whole: dict[str, bytes], tmp_path: Path) -> None:
    """Up to ten times a worker is killed, or a node, which another one then replaces."""
    output = tmp_path / "data"
    killed = list[str]()
    rng = default_rng(7)
    made_nodes, place = nodes
    work = partial(generate, toy_scene(), output, SMALL, examples=EXAMPLES, seed=3, ray=made_nodes.address)
    with ThreadPoolExecutor(1) as thread:  # nodes can be started in the main thread alone
        made = thread.submit(work)
        while len(killed) < KILLS and not made.done():
            time.sleep(0.05)
            if len(list(output.glob("shard-*"))) <= 2 * len(killed):
                continue
            if len(killed) % 3 == 0:
                alive = list(made_nodes.worker_nodes)
                made_nodes.remove_node(alive[int(rng.integers(len(alive)))], allow_graceful=False)
                made_nodes.add_node(num_cpus=1)
                killed.append("node")
            elif busy := working(place):
                os.kill(int(rng.choice(busy)), signal.SIGKILL)
                killed.append("worker")
        made.result()
    assert {"node", "worker"} <= set(killed), "a fast machine is done before the last of them"
    assert contents(output) == whole
    assert made_nodes.worker_nodes and processes("raylet", place), "a cluster that was there stays"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_command_leaves_nothing(number: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C reaches all processes of a terminal; TERM and KILL the command alone."""
    output = tmp_path / "data"
    options = "--ray local --workers 2 --image-size 32 --points 64 --per-segment 8"
    line = f"generate shapes --examples 6400 --test --seed 1000003 --output {output} {options}"
    command, _ = started(line, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        os.killpg(command.pid, number) if number == signal.SIGINT else command.send_signal(number)
        errors = command.communicate(timeout=60)[1]
    finally:
        command.kill()
    end = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "stopped by SIGTERM"), signal.SIGKILL: (-9, "")}
    assert command.returncode == end[number][0], errors
    if number != signal.SIGKILL:
        assert errors.splitlines()[-1] == f"mereo: {end[number][1]}" and not has_left(command.pid)
        assert not [place for place in output.iterdir() if place.name.endswith(".mereo")]


def without_seconds(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if "seconds" not in key}
    return [without_seconds(item) for item in value] if isinstance(value, list) else value


def test_scores_are_those_of_one_process(rope: Model, tmp_path: Path) -> None:
    places = {"here": 1, "one": Cluster(local_cpus=1), "two": Cluster(local_cpus=2)}
    for name, workers in places.items():
        config = EvaluationConfig(examples=5, cells=24, method="modes")
        evaluate_weights(rope, tmp_path / name, config, workers=workers)
    here, one, two = (without_seconds(read_json(tmp_path / name / "metrics.json")) for name in places)
    assert here == one == two and here["examples"] == 5
    assert (tmp_path / "one/errors.png").read_bytes() == (tmp_path / "two/errors.png").read_bytes()


def test_frames_have_the_answers_of_one_process(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture
) -> None:
    folder = frames(tmp_path / "frames", "a.npy", "b.npy", "c.npy")
    (folder / "bad.ply").write_text("nonsense")
    assert run(folder, "--output", tmp_path / "here") == 2
    assert run(folder, "--output", tmp_path / "there", "--ray", "local", "--threads", "2") == 2
    said = capsys.readouterr()
    assert said.err.count("bad.ply cannot be read as a point cloud") == 2
    assert said.out.count("4 frames, results in") == 2 and said.out.count("\n[4/4] ") == 2
    assert sorted(place.name for place in (tmp_path / "there").iterdir()) == ["a", "b", "c"]
    for name in "abc":
        assert content(tmp_path / "here" / name) == content(tmp_path / "there" / name)
    assert run(folder, "--output", tmp_path / "there", "--ray", "local", "--threads", "1") == 2
    assert capsys.readouterr().err.count("exists and is not empty") == 3


def test_with_json_nothing_of_ray_gets_to_standard_output(tmp_path: Path) -> None:
    """Ray prints on it that a worker has died."""
    known = write_angle(tmp_path)
    scene = scene_of_meshes(known, "mm")
    (tmp_path / "frames").mkdir()
    for number in range(3):
        view = sample_view(scene, GenerateConfig(), example_rng(1000, number))
        np.save(tmp_path / f"frames/{number}.npy", 0.001 * view.depth.to_points().points)
    line = f"reconstruct {tmp_path}/frames --units mm --unit-m 1 --resolution 24 --output {tmp_path}/out --json"
    objects = " ".join(map(str, known))
    command, busy = started(f"{line} --ray local --threads 1 --object {objects}", stdout=subprocess.PIPE)
    os.kill(busy[0], signal.SIGKILL)
    out, errors = command.communicate(timeout=500)
    assert command.returncode in (0, 3, 4) and len(json.loads(out)["frames"]) == 3, errors
