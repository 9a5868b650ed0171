"""A Ray cluster gives the bits of one process: for any number of workers and nodes, and whichever of them dies."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from angle import write_angle
from folder_contents import contents
from many_frames import content, frames, loads, run
from object_work import folder_of_objects
from toy_data import SMALL
from toy_scene import toy_scene

from mereo import __main__ as command_line
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


def processes(*words: str) -> list[int]:
    """Living processes whose command lines have all of these words."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            line = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if all(word in line for word in words):
            found.append(int(place.name))
    return sorted(found)


def parent(process: int) -> int:
    """Process that has started another one; 0 where that is gone."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def working(place: str) -> list[int]:
    """Workers at a task, of the cluster whose files lie in a folder."""
    nodes = processes("raylet", place)
    return [process for process in processes("ray::_apply") if parent(process) in nodes]


def folder_of_ray(process: int) -> str:
    """Beginning of the folder in which a process has Ray's files."""
    return f"/tmp/mereo-ray-{process}-"


def is_left(process: int) -> bool:
    """Whether there are Ray's files of a process."""
    return any(str(place).startswith(folder_of_ray(process)) for place in Path("/tmp").iterdir())


def gone(*words: str, within_s: float = 15.0) -> bool:
    """Whether such processes end soon."""
    until = time.monotonic() + within_s
    while processes(*words) and time.monotonic() < until:
        time.sleep(0.2)
    return not processes(*words)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_change_no_bit(workers: int, whole: dict[str, bytes], tmp_path: Path) -> None:
    generate(toy_scene(), tmp_path / "data", SMALL, examples=EXAMPLES, seed=3, workers=workers, ray="local")
    assert contents(tmp_path / "data") == whole
    assert gone(folder_of_ray(os.getpid())) and not is_left(os.getpid())


def test_nodes_that_die_lose_nothing(nodes: tuple[Any, str], whole: dict[str, bytes], tmp_path: Path) -> None:
    """Up to ten times a worker is killed, or a node, which another one then replaces."""
    output, killed, rng = tmp_path / "data", list[str](), np.random.default_rng(7)
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
    line = f"generate shapes --examples 6400 --test --seed 1000003 --output {output} --ray local --workers 2"
    command = subprocess.Popen(
        [sys.executable, "-m", "mereo", *line.split(), *["--image-size", "32", "--points", "64", "--per-segment", "8"]],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        text=True,
    )
    try:
        until = time.monotonic() + 300
        while not working(folder_of_ray(command.pid)) and time.monotonic() < until and command.poll() is None:
            time.sleep(0.1)
        if number == signal.SIGINT:
            os.killpg(command.pid, number)
        else:
            command.send_signal(number)
        said = command.communicate(timeout=60)[1]
    finally:
        command.kill()
    assert command.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number], said
    assert gone(folder_of_ray(command.pid))
    if number != signal.SIGKILL:
        assert said.splitlines()[-1] == (
            "mereo: interrupted" if number == signal.SIGINT else "mereo: stopped by SIGTERM"
        )
        assert not [place for place in output.iterdir() if place.name.endswith(".mereo")]
        assert not is_left(command.pid)


def without_seconds(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if "seconds" not in key}
    return [without_seconds(item) for item in value] if isinstance(value, list) else value


def test_scores_are_those_of_one_process(rope: Model, tmp_path: Path) -> None:
    places: dict[str, int | Cluster] = {"here": 1, "one": Cluster(local_cpus=1), "two": Cluster(local_cpus=2)}
    for name, workers in places.items():
        config = EvaluationConfig(examples=5, cells=24, method="modes")
        evaluate_weights(rope, tmp_path / name, config, workers=workers)
    here, one, two = (without_seconds(json.loads((tmp_path / name / "metrics.json").read_text())) for name in places)
    assert here == one == two and here["examples"] == 5
    assert (tmp_path / "one/errors.png").read_bytes() == (tmp_path / "two/errors.png").read_bytes()


def test_frames_are_answered_as_by_one_process(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture[str]
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
        listed = [json.loads((tmp_path / place / name / ".mereo.json").read_text()) for place in ("here", "there")]
        assert listed[0].keys() == listed[1].keys()
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
    command = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "mereo",
            *line.split(),
            "--ray",
            "local",
            "--threads",
            "1",
            "--object",
            *map(str, known),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 300
    while not (busy := working(folder_of_ray(command.pid))) and time.monotonic() < until and command.poll() is None:
        time.sleep(0.1)
    os.kill(busy[0], signal.SIGKILL)
    out, said = command.communicate(timeout=500)
    assert command.returncode in (0, 3) and len(json.loads(out)["frames"]) == 3, said


def test_an_object_that_fails_in_its_task_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = folder_of_objects(tmp_path)
    (folder / "pole.yaml").write_text("no scene")
    (folder / "bar/left.stl").write_text("no mesh")
    line = f"learn {folder} --output {tmp_path / 'out'} --minutes 0.1 --ray local --threads 2 --cpus-per-object 1"
    assert command_line.main(line.split()) == 2
    said = capsys.readouterr()
    assert "mereo: error: bar: " in said.err and "mereo: error: pole: " in said.err
    assert "2 of 2 objects could not be learnt (bar, pole)" in said.err
    assert (tmp_path / "out/bar.log").is_file()
