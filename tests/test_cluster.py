"""Work on a Ray cluster: the contract of worker processes, and one sentence for what cannot be."""

import os
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cluster_work import Cancelled, die, die_once, fail_on_three, report, square, wait_long
from scene_files import write_bar

from mereo import __main__ as command_line
from mereo.io.cores import THREAD_VARIABLES
from mereo.learning import object_folders
from mereo.learning.object_folders import learn_objects, objects_in
from mereo.models.config import InferenceConfig
from mereo.models.elsewhere import for_tasks, sent
from mereo.models.model import Model
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.workers import tasks
from mereo.workers.cluster import connected, ray_library
from mereo.workers.config import Cluster, TaskResources, cluster_of
from mereo.workers.installation import installation
from mereo.workers.spread import in_order, spread
from mereo.workers.tasks import in_tasks

HERE = Cluster(local_cpus=2)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A cluster of this machine, which all tests share: starting one takes seconds."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'mereo[cluster]'")
    with connected(HERE):
        yield HERE


# --- tasks ------------------------------------------------------------------------------------------------------------


def test_every_item_once_in_other_processes_of_one_thread(cluster: Cluster) -> None:
    assert dict(in_tasks(square, range(20), cluster)) == {n: n * n for n in range(20)}
    assert dict(in_tasks(lambda number, cancelled: -number, [1, 2], cluster)) == {1: -1, 2: -2}
    assert list(in_tasks(square, [], cluster)) == []
    workers, variables, gpus = zip(*dict(in_tasks(report, range(8), cluster)).values(), strict=True)
    assert os.getpid() not in workers and all(value == ["1"] * len(THREAD_VARIABLES) for value in variables)
    assert set(gpus) == {""}, "a task that asked for no GPU sees none"


def test_items_are_taken_as_they_are_needed(cluster: Cluster) -> None:
    taken: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number

    results = in_tasks(square, numbers(), cluster)
    next(results)
    assert len(taken) == 2 * tasks.AHEAD, "two CPUs, and as many items again on their way"
    results.close()


def test_an_error_arrives_as_it_was_raised_and_is_not_tried_again(cluster: Cluster) -> None:
    with pytest.raises(ValueError, match="^three is bad: pass another number$") as raised:
        list(in_tasks(fail_on_three, range(50), cluster))
    assert type(raised.value) is ValueError and "in fail_on_three" in str(raised.value.__cause__)


@pytest.mark.slow
def test_work_that_cannot_be_sent_is_refused(cluster: Cluster) -> None:
    with socket.socket() as unsendable:
        work = lambda number, cancelled: (unsendable, number)  # noqa: E731
        with pytest.raises(ValueError, match="the work cannot be sent to a cluster .*; mend that, or leave out --ray"):
            list(in_tasks(work, [1], cluster))


def test_items_of_killed_workers_are_done_again(cluster: Cluster, tmp_path: Path) -> None:
    items = [(str(tmp_path), number) for number in range(6)]
    assert sorted(number for _, number in in_tasks(die_once, items, cluster)) == list(range(6))
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_an_item_that_kills_every_worker_is_said_or_replaced(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "DEATHS", 1)
    with pytest.raises(ChildProcessError, match="2 workers or nodes died of one task .*most often for memory.*again"):
        list(in_tasks(die, [0, 1], cluster))
    assert dict(in_tasks(die, [0, 1], cluster, lambda item, error: -item)) == {0: 0, 1: -1}


@pytest.mark.slow
def test_closing_ends_tasks_that_run(cluster: Cluster) -> None:
    results = in_tasks(wait_long, range(50), cluster)
    assert next(results) == (0, 0)
    results.close()
    assert dict(in_tasks(square, [2], cluster)) == {2: 4}, "a CPU is free again"


def test_a_scene_of_a_python_file_is_sent_with_its_code(cluster: Cluster, tmp_path: Path) -> None:
    file = tmp_path / "bent.py"
    file.write_text(
        "from toy_scene import rest_mesh, sample_deformations\nfrom mereo.scenes.scene import Scene, Workspace\n"
        "LIMIT = 2\ndef sampler(rng):\n    assert LIMIT == 2\n    return sample_deformations(rng)\n"
        "def scene():\n    return Scene('bent', rest_mesh(), sampler, Workspace())\n"
    )
    scene = load_scene(file)
    file.unlink()  # as on another machine

    def states(seed: int, cancelled: Cancelled) -> bytes:
        return scene.sample_state(example_rng(1, seed)).mesh.merged()[0].tobytes()

    assert dict(in_tasks(states, range(3), cluster)) == {seed: states(seed, lambda: False) for seed in range(3)}


@pytest.mark.slow
def test_other_code_on_a_node_is_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = installation()
    monkeypatch.setattr("mereo.workers.cluster.installation", lambda: replace(ours, code="other"))
    with pytest.raises(ValueError, match=r"node .* has other code of mereo .* install the same there"):
        list(in_tasks(square, [1], cluster))


# --- without a cluster ------------------------------------------------------------------------------------------------


def test_without_ray_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(
        ImportError, match=r"Ray, which --ray needs, is not installed: run pip install 'mereo\[cluster\]'"
    ):
        list(spread(square, [1], cluster=HERE))


def test_results_come_in_order() -> None:
    found = ((n, str(n)) for n in (2, 0, 1, 4, 3))
    assert list(in_order(found)) == ["0", "1", "2", "3", "4"]


def test_installations_are_told_apart() -> None:
    ours = installation()
    assert ours.difference(ours, "node b") is None
    older = replace(
        ours, versions=tuple((name, "1.0" if name == "scipy" else number) for name, number in ours.versions)
    )
    said = ours.difference(older, "node b")
    assert said is not None and said.startswith("node b has scipy 1.0 and this machine ")


def test_resources_belong_to_a_cluster() -> None:
    task = TaskResources(2, 0.5)
    assert cluster_of(None) is None
    assert cluster_of("auto", 3, task) == Cluster("auto", 2, 0.5, 3)
    with pytest.raises(ValueError, match="are for tasks of a cluster: give --ray local"):
        cluster_of(None, 0, task)


def test_the_device_is_what_tasks_have() -> None:
    gpus = Cluster(gpus=1.0)
    assert for_tasks(InferenceConfig(), None) == InferenceConfig()
    assert for_tasks(InferenceConfig(), gpus).device == "cpu", "here; they move it"
    with pytest.raises(ValueError, match="--device is cuda, but tasks have no GPU"):
        for_tasks(InferenceConfig(device="cuda"), HERE)
    with pytest.raises(ValueError, match="--device is cpu, but tasks have GPUs"):
        for_tasks(InferenceConfig(device="cpu"), gpus)


def test_precision_is_decided_once(rope: Model) -> None:
    auto = replace(rope, precision="auto")
    assert sent(auto, Cluster(gpus=0.5)).precision == "bfloat16"
    assert sent(auto, HERE).precision == auto.working_precision
    assert sent(rope, HERE).precision == "float32"


COMMANDS = {
    "generate": "generate rope --examples 1 --output out --ray",
    "evaluate": "evaluate rope --output out --ray",
    "learn": "learn objects --output out --ray",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_address_is_one_sentence(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'mereo[cluster]'")
    monkeypatch.setattr(ray_library(), "is_initialized", lambda: False)  # a test before may share its cluster
    monkeypatch.chdir(tmp_path)
    folder_of_objects(tmp_path)
    with socket.socket() as taken:  # nobody listens there
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert command_line.main([*COMMANDS[command].split(), address]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"mereo: error: there is no Ray cluster at {address} (") and said.endswith("--ray local")
    assert command_line.main([*COMMANDS[command].split(), "ray://host:10001"]) == 2
    assert "it must be local, auto, or the HOST:PORT" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_single_frame_or_object_is_no_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line, sentence in (
        (f"reconstruct {tmp_path}/a.ply --weights rope --output out --ray local", "--ray is for several frames"),
        (f"learn {tmp_path}/a.stl --output out --ray local", "--ray is for a folder of objects"),
        ("evaluate bunny --output out --scans --ray local", "--scans are few and are scored here: leave out --ray"),
        ("evaluate bunny --output out --gpus-per-task 1", "are for tasks of a cluster"),
    ):
        assert command_line.main(line.split()) == 2
        assert sentence in capsys.readouterr().err


# --- folders of objects -----------------------------------------------------------------------------------------------


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


def test_objects_of_a_folder(tmp_path: Path) -> None:
    folder = folder_of_objects(tmp_path)
    expected = [("bar", (folder / "bar/left.stl", folder / "bar/right.stl")), ("pole", (folder / "pole.yaml",))]
    assert objects_in(folder) == expected
    (folder / "bar/bar.yaml").write_text("a scene file is what a subfolder is")
    assert objects_in(folder)[0] == ("bar", (folder / "bar/bar.yaml",))
    for name, sentence in (
        ("bar/other.py", "has 2 scene files, bar.yaml and other.py"),
        ("loose.stl", "loose.stl lies loose in a folder of objects"),
        ("Bar.yaml", "has 2 objects named 'bar'"),
    ):
        (folder / name).touch()
        with pytest.raises(ValueError, match=sentence):
            objects_in(folder)
        (folder / name).unlink()
    with pytest.raises(ValueError, match="has no objects; each is a scene file"):
        objects_in(folder / "notes")


def test_a_failed_object_stops_no_other_and_the_same_call_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    learnt: list[str] = []

    def learn(files: tuple[Path, ...], output: Path, **settings: object) -> dict[str, object]:
        learnt.append(output.name)
        assert settings == {"minutes": 2.0, "init": "", "units": None, "workers": 1, "train": "auto"}
        if output.name == "bar" and len(learnt) < 3:
            raise ValueError("the bar is bent: straighten it")
        return {"iou": 0.9, "miou": None, "trained": True, "method": "auto"}

    monkeypatch.setattr(object_folders, "learn", learn)
    folder, out = folder_of_objects(tmp_path), tmp_path / "out"
    with pytest.raises(ValueError, match=r"1 of 2 objects could not be learnt \(bar\)"):
        learn_objects(folder, out, minutes=2.0)
    printed = capsys.readouterr()
    assert printed.err == "mereo: error: bar: the bar is bent: straighten it\n"
    assert "2 objects in " in printed.out and "failed" in printed.out and "0.900" in printed.out
    assert [one.metrics is not None for one in learn_objects(folder, out, minutes=2.0)] == [True, True]
    assert learnt == ["bar", "pole", "bar", "pole"]
    with pytest.raises(ValueError, match=r"was begun with minutes = 2.0, not 3.0"):
        learn_objects(folder, out, minutes=3.0)
