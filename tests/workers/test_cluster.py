"""Work in other processes and on a Ray cluster: its contract, and one sentence for what cannot be."""

import os
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cluster_work import die, die_once, fail_on_three, report, square, wait_long
from folder_contents import run_mereo
from scene_files import write_bar

from mereo import __main__ as command_line
from mereo.io.cores import THREAD_VARIABLES
from mereo.models.config import InferenceConfig
from mereo.models.model import Model
from mereo.models.weights import settings_for, to_cpu
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.workers import spread as spreading
from mereo.workers.spread import Cluster, TaskResources, choose_cluster, connect, spread
from mereo_learning import learn as learning
from mereo_learning.learn import LearnConfig, learn_objects, list_objects


def folder_of_objects(top: Path) -> Path:
    """Two objects: a subfolder of meshes, and a scene file."""
    (top / "objects/bar").mkdir(parents=True)
    write_bar(top / "objects/bar").unlink()
    (top / "meshes").mkdir()
    write_bar(top / "meshes")
    scene = (top / "meshes/bar.yaml").read_text().replace("file: ", "file: ../meshes/")
    (top / "objects/pole.yaml").write_text(scene.replace("name: bar", "name: pole"))
    (top / "objects/notes").mkdir()
    (top / "objects/notes/readme.txt").write_text("no object")
    return top / "objects"


HERE = Cluster(local_cpus=2)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A cluster of this machine, which all tests share: starting one takes seconds."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'mereo[cluster]'")
    with connect(HERE):
        yield HERE


def test_every_item_once_in_other_processes_of_one_thread(cluster: Cluster) -> None:
    assert dict(spread(square, range(20), cluster)) == {n: n * n for n in range(20)}
    assert dict(spread(lambda number: -number, [1, 2], cluster)) == {1: -1, 2: -2}
    assert list(spread(square, [], cluster)) == []
    workers, variables, gpus = zip(*dict(spread(report, range(8), cluster)).values(), strict=True)
    assert os.getpid() not in workers and all(value == ["1"] * len(THREAD_VARIABLES) for value in variables)
    assert set(gpus) == {""}, "a task that asked for no GPU sees none"


def test_other_machines_cannot_reach_it(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    psutil, ray = pytest.importorskip("psutil"), pytest.importorskip("ray")
    family = [psutil.Process(), *psutil.Process().children(recursive=True)]
    sockets = [socket for process in family for socket in process.net_connections("inet")]
    listening = {socket.laddr.ip.removeprefix("::ffff:") for socket in sockets if socket.status == "LISTEN"}
    assert listening == {"127.0.0.1"}
    monkeypatch.setattr(ray, "nodes", lambda: [{"NodeManagerAddress": "192.0.2.2"}])
    sentence = r"--ray local listen on 192.0.2.2; they must .*give --ray auto"
    with pytest.raises(ConnectionError, match=sentence), spreading._loopback(ray):
        pass


def test_items_are_taken_as_they_are_needed(cluster: Cluster) -> None:
    taken = []

    def numbers() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number

    results = spread(square, numbers(), cluster)
    next(results)
    assert len(taken) == 2 * spreading.AHEAD, "two CPUs, and as many items again on their way"
    results.close()


def test_an_error_arrives_as_it_was_raised_and_is_not_tried_again(cluster: Cluster) -> None:
    with pytest.raises(ValueError, match="^three is bad: pass another number$") as raised:
        list(spread(fail_on_three, range(50), cluster))
    assert type(raised.value) is ValueError and "fail_on_three" in str(raised.value.__cause__)
    assert dict(spread(fail_on_three, range(5), cluster, lambda item, error: -item))[3] == -3


def test_items_of_killed_workers_are_done_again(cluster: Cluster, tmp_path: Path) -> None:
    items = [(str(tmp_path), number) for number in range(6)]
    assert sorted(number for _, number in spread(die_once, items, cluster)) == list(range(6))
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_an_item_that_kills_every_worker_is_said_or_replaced(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spreading, "DEATHS", 1)
    with pytest.raises(ChildProcessError, match="2 workers or nodes died of one task .*most often for memory.*again"):
        list(spread(die, [0, 1], cluster))
    assert dict(spread(die, [0, 1], cluster, lambda item, error: -item)) == {0: 0, 1: -1}


@pytest.mark.slow
def test_closing_ends_tasks_that_run(cluster: Cluster) -> None:
    results = spread(wait_long, range(50), cluster)
    assert next(results) == (0, 0)
    results.close()
    assert dict(spread(square, [2], cluster)) == {2: 4}, "a CPU is free again"


def test_a_scene_of_a_python_file_is_sent_with_its_code(cluster: Cluster, tmp_path: Path) -> None:
    file = tmp_path / "bent.py"
    file.write_text(
        "from toy_scene import rest_mesh, sample_deformations\nfrom mereo.scenes.scene import Scene, Workspace\n"
        "LIMIT = 2\ndef sampler(rng):\n    assert LIMIT == 2\n    return sample_deformations(rng)\n"
        "def scene():\n    return Scene('bent', rest_mesh(), sampler, Workspace())\n"
    )
    scene = load_scene(file)
    file.unlink()  # as on another machine

    def states(seed: int) -> bytes:
        return scene.sample_state(example_rng(1, seed)).mesh.merged()[0].tobytes()

    assert dict(spread(states, range(3), cluster)) == {seed: states(seed) for seed in range(3)}


def test_without_ray_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"--ray needs ray, which is not installed: pip install 'mereo\[cluster\]'"):
        list(spread(square, [1], HERE))


def test_resources_belong_to_a_cluster() -> None:
    task = TaskResources(2, 0.5)
    assert choose_cluster(None) is None
    assert choose_cluster("auto", 3, task) == Cluster("auto", 2, 0.5, 3)
    with pytest.raises(ValueError, match="are for tasks of a cluster: give --ray local"):
        choose_cluster(None, 0, task)


def test_the_device_is_what_tasks_have() -> None:
    gpus = Cluster(gpus=1.0)
    assert settings_for(InferenceConfig(), 1) == InferenceConfig()
    assert settings_for(InferenceConfig(), gpus).device == "cpu", "here; they move it"
    for device, tasks, have in (("cuda", HERE, "cpu"), ("cpu", gpus, "cuda")):
        with pytest.raises(ValueError, match=f"--device is {device}, but tasks of the cluster compute on {have}"):
            settings_for(InferenceConfig(device=device), tasks)


def test_precision_is_decided_once(rope: Model) -> None:
    auto = replace(rope, precision="auto")
    assert to_cpu(auto, Cluster(gpus=0.5)).precision == "bfloat16"
    assert to_cpu(auto, HERE).precision == auto.working_precision
    assert to_cpu(rope, HERE).precision == "float32"


@pytest.mark.parametrize(
    "command",
    [
        "generate rope --examples 1 --output out --ray",
        "evaluate rope --output out --ray",
        "reconstruct a.ply b.ply --weights rope --output out --ray",
        "learn objects --output out --ray",
    ],
)
def test_a_wrong_address_is_one_sentence(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'mereo[cluster]'")
    monkeypatch.chdir(tmp_path)
    folder_of_objects(tmp_path)
    with socket.socket() as taken:  # nobody listens there
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert run_mereo(*command.split(), address) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"mereo: error: there is no Ray cluster at '{address}' (") and "HOST:PORT" in said
    assert run_mereo(*command.split(), "ray://host:10001") == 2
    assert "give local, auto, or the HOST:PORT that" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_single_frame_is_no_task(working_folder: Path, capsys: pytest.CaptureFixture) -> None:
    for line, sentence in (
        (f"reconstruct {working_folder}/a.ply --weights rope --output out --ray local", "--ray is for several frames"),
        (f"learn {working_folder}/a.stl --output out --ray local", "--ray is for a folder of objects"),
        ("evaluate bunny --output out --scans --ray local", "--scans are few and are scored here: leave out --ray"),
        ("evaluate bunny --output out --gpus-per-task 1", "are for tasks of a cluster"),
    ):
        assert command_line.main(line.split()) == 2
        assert sentence in capsys.readouterr().err


def test_objects_of_a_folder(tmp_path: Path) -> None:
    folder = folder_of_objects(tmp_path)
    expected = [("bar", [folder / "bar/left.stl", folder / "bar/right.stl"]), ("pole", [folder / "pole.yaml"])]
    assert list_objects(folder) == expected
    (folder / "bar/bar.yaml").write_text("a scene file is what a subfolder is")
    assert list_objects(folder)[0] == ("bar", [folder / "bar/bar.yaml"])
    for name, sentence in (
        ("loose.stl", "loose.stl lies loose in a folder of objects"),
        ("Bar.yaml", "has two objects of one name among"),
    ):
        (folder / name).touch()
        with pytest.raises(ValueError, match=sentence):
            list_objects(folder)
        (folder / name).unlink()
    with pytest.raises(ValueError, match="has no objects; each is a scene file"):
        list_objects(folder / "notes")


def test_a_failed_object_stops_no_other_and_the_same_call_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    learnt = []

    def learn(files: list[Path], output: Path, config: LearnConfig) -> dict[str, object]:
        learnt.append(output.name)
        assert config == LearnConfig(minutes=2.0)
        if output.name == "bar" and len(learnt) < 3:
            raise ValueError("the bar is bent: straighten it")
        return {"iou": 0.9, "miou": None, "trained": True, "method": "auto"}

    monkeypatch.setattr(learning, "learn", learn)
    folder = folder_of_objects(tmp_path)
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"1 of 2 objects could not be learnt \(bar\)"):
        learn_objects(folder, out, LearnConfig(minutes=2.0))
    printed = capsys.readouterr()
    assert printed.err == "mereo: error: bar: the bar is bent: straighten it\n"
    assert printed.out.endswith(f"\n{out}/pole: IoU 0.900, mIoU -, method auto\n")
    learn_objects(folder, out, LearnConfig(minutes=2.0))
    assert learnt == ["bar", "pole", "bar", "pole"]


# --- processes of this machine ----------------------------------------------------------------------------------------


def test_one_worker_works_here_and_in_order_and_its_errors_arrive_or_are_replaced() -> None:
    assert list(spread(square, [3, 1, 2])) == [(3, 9), (1, 1), (2, 4)]
    assert next(spread(report, [0], 8))[1][0] == os.getpid()
    assert list(spread(square, [], 4)) == []
    with pytest.raises(ValueError, match="three is bad"):
        list(spread(fail_on_three, range(5)))
    assert dict(spread(fail_on_three, range(5), 1, lambda item, error: -item))[3] == -3


def test_work_that_cannot_be_sent_is_refused_with_the_cure() -> None:
    with pytest.raises(ValueError, match="cannot be sent to other processes .*top level of a module, .* use one"):
        list(spread(lambda number: number, [1, 2], 2))


@pytest.mark.slow
def test_every_item_once_in_processes_of_this_machine() -> None:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    assert dict(spread(square, range(20), 2)) == {n: n * n for n in range(20)}
    workers, variables, _ = zip(*dict(spread(report, range(20), 2)).values(), strict=True)
    assert os.getpid() not in workers and len(set(workers)) <= 2
    assert all(value == ["1"] * len(THREAD_VARIABLES) for value in variables)
    assert before == {name: os.environ.get(name) for name in THREAD_VARIABLES}


@pytest.mark.slow
def test_an_error_in_a_worker_ends_the_work() -> None:
    with pytest.raises(ValueError, match="three is bad"):
        list(spread(fail_on_three, range(50), 2))


@pytest.mark.slow
def test_a_killed_worker_is_one_sentence_and_no_hang() -> None:
    with pytest.raises(ChildProcessError, match="a worker process was killed, most often for memory.*--resume"):
        list(spread(die, range(50), 2))


@pytest.mark.slow
def test_closing_ends_work_in_progress() -> None:
    results = spread(wait_long, range(50), 2)
    assert next(results) == (0, 0)
    results.close()  # returns, though one worker would not have for a minute
