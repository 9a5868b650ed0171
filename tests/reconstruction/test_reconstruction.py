"""From a cloud to segments, in the input's frame and units, and to files."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from analytic import AnalyticModel, ball, logits_of, union
from answers import answer_to, reconstruct
from folder_contents import read_json
from many_frames import content, frames, loads, run
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from two_balls import BIG, NAMES, SMALL, front, scene, two_balls

import mereo
from mereo.cli import reconstruct as many
from mereo.cli.answers import ReconstructCommand, StreamCommand
from mereo.cli.reconstruct import FrameJob, reconstruct_file
from mereo.cli.stream import stream_reconstructions
from mereo.fitting.registration.answer import Answer
from mereo.io.atomic_files import MARKER
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import SizeWarning
from mereo.reconstruction.pipeline import Reconstruction, count_parts
from mereo.visualization.result_files import write_answer

pytestmark = pytest.mark.usefixtures("small_previews")


@pytest.fixture(scope="module", params=["camera", "scanner"])
def answer(request: pytest.FixtureRequest) -> Answer:
    cloud, model = scene(request.param)
    return answer_to(cloud, model, resolution=48, axes=request.param)


def test_labels_are_the_fields_at_their_positions(answer: Answer) -> None:
    found = answer.reconstruction
    grid = found.labels
    index = np.indices(grid.labels.shape).reshape(3, -1).T
    expected = two_balls(grid.positions(index)).argmax(axis=1)
    assert (grid.labels.ravel() != expected).mean() < 1e-4, "rounding on the surface"
    assert grid.names == NAMES and not found.clipped


def test_segments_are_where_they_are_and_an_absent_one_is_listed(answer: Answer) -> None:
    found = answer.reconstruction
    absent = found.segments[2]
    assert (absent.name, absent.volume, absent.voxels, absent.components) == ("absent", 0.0, 0, 0)
    assert np.isnan(absent.confidence) and np.isnan(absent.box).all()
    assert len(found.surfaces.segments[2].faces) == 0
    for segment, surface, (center, radius) in zip(found.segments, found.surfaces.segments, (BIG, SMALL), strict=False):
        assert_allclose(segment.centroid, center, atol=0.001)
        assert_allclose(segment.box, np.add(center, [[-radius] * 3, [radius] * 3]), atol=0.0005)
        assert segment.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)
        assert segment.volume == pytest.approx(surface.volume)
        assert surface.edge_imbalance() == (0, 0)
        assert segment.components == 1 and 0.5 < segment.confidence <= 1.0
        assert_allclose(surface.bounds, segment.box, atol=1e-9)


def test_parts_are_counted_as_a_person_would_and_nothing_is_removed() -> None:
    """Two balls; the third one, shorter than a tenth of the first, is a speck."""
    apart = logits_of(union(ball((0.0, 0.0, 5.0), 0.5), ball((0.0, 1.0, 5.0), 0.1), ball((0.8, 0.0, 5.0), 0.04)))
    cloud = np.concatenate([front((0.0, 0.0, 5.0), 0.5, -1.0), front((0.0, 1.0, 5.0), 0.1, -1.0)])
    segment = reconstruct(cloud, AnalyticModel.of(apart, ("one",)), resolution=96).segments[0]
    assert segment.components == 2
    assert segment.volume == pytest.approx(4 / 3 * np.pi * (0.5**3 + 0.1**3 + 0.04**3), rel=0.02)


def test_specks_and_gaps_below_a_voxel_are_no_parts() -> None:
    mask = np.zeros((40, 8, 8), bool)
    mask[:20, 2:5, 2:5] = mask[20:30, 5:7, 5:7] = True  # they touch at a corner
    assert count_parts(mask) == 1
    mask[38, 0, 0] = True
    assert count_parts(mask) == 1, "a speck"
    mask[34:38, 0, 0] = True
    assert count_parts(mask) == 2
    assert count_parts(mask[38:39]) == 1, "a single voxel, where it is all"


def test_files(answer: Answer, tmp_path: Path) -> None:
    frame = answer.seen.frame.axes
    result = answer.reconstruction
    (tmp_path / "out").mkdir()
    write_answer(tmp_path / "out", answer)
    files = {"labels.npz", "preview.png", "report.html", "segments.glb", "summary.json"}
    assert {path.name for path in (tmp_path / "out").glob("[!.]*")} == files
    with np.load(tmp_path / "out/labels.npz") as stored:
        assert_array_equal(stored["labels"], result.labels.labels)
        assert_array_equal(stored["origin"], result.labels.origin)
        assert tuple(stored["names"]) == NAMES
    summary = read_json(tmp_path / "out/summary.json")
    assert [(s["name"], s["volume"] > 0) for s in summary["segments"]] == [("big", 1), ("small", 1), ("absent", 0)]
    assert summary["segments"][2]["confidence"] is None and summary["frame"] == frame
    assert list(summary)[:7] == ["title", "verdict", "recognition", "frame", "unit_m", "pose", "segments"]
    assert set(summary["timings_s"]) == {"encode", "locate", "extract", "measure", "write"}
    loaded = trimesh.load_scene(tmp_path / "out/segments.glb")
    assert set(loaded.geometry) == {"big", "small"}
    assert_allclose(loaded.geometry["big"].vertices.mean(axis=0), BIG[0], atol=0.002)
    # the root node turns the frame for viewers: y up in both cases, z toward the viewer
    place = loaded.graph.get("big")[0] @ [*BIG[0], 1.0]
    assert_allclose(place[:3], np.array(BIG[0]) * ([1, -1, -1] if frame == "camera" else 1), atol=1e-6)


FAR_BEHIND = default_rng(1).uniform((-0.3, -0.3, 0.9), (0.3, 0.3, 1.3), (30, 3))


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Reconstruction]:
    """Answer to a cloud in metres, written into a folder, by a model of a known true size."""

    def answered(folder: str, cloud: np.ndarray, visible_m: list[float], **isolation: Any) -> Reconstruction:
        model = replace(scene("camera")[1], provenance={"visible_m": visible_m})
        monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: model)
        np.save(tmp_path / "cloud.npy", cloud)
        command = ReconstructCommand((), weights="any", resolution=16, reading=InputConfig(unit_m=1.0))
        job = FrameJob(replace(command, isolation=IsolationConfig(**isolation)))
        return reconstruct_file(tmp_path / "cloud.npy", tmp_path / folder, job).reconstruction

    return answered


def test_what_is_read_and_left_out_is_printed_and_kept(
    read: Callable[..., Reconstruction], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    cloud = scene("camera")[0]
    crowded = np.concatenate([cloud, front((0.9, 0.0, 0.9), 0.03, -1.0)])
    with pytest.warns(SizeWarning, match="the visible part is 0.97 m long, but 2 to 3 m in training: other things"):
        read("crowded", crowded, [2, 3])
    assert "strays:" not in capsys.readouterr().out, "it is a surface: nothing says that it is not the object"
    with pytest.warns(SizeWarning, match="the visible part is 0.1[0-9]* m long"):
        read("alone", crowded, [2, 3], largest_cluster=True, cluster_gap=0.02)
    assert "largest cluster: 1200 of 1800 points kept (1 of 2 clusters" in capsys.readouterr().out
    summary = read_json(tmp_path / "alone/summary.json")
    assert summary["points"] == 1200 and summary["isolation"][-1]["name"] == "largest cluster"
    assert_allclose(summary["depth_m"], np.quantile(cloud[:, 2], [0, 0.5, 1]))
    assert max(summary["visible_size_m"]) == pytest.approx(np.ptp(cloud[:, 1]), rel=1e-6)


def test_strays_are_dropped_and_said_unless_all_are_to_be_kept(
    read: Callable[..., Reconstruction], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own, model = scene("camera")
    cloud = np.concatenate([own, FAR_BEHIND])
    result = read("out", cloud, [0.1, 0.2])
    said = capsys.readouterr().out
    assert "strays: 30 of 1230 points dropped, the longest side was" in said and "(--keep-all keeps them)" in said
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["points"] == 1200 and max(summary["visible_size_m"]) < 0.2
    (step,) = summary["isolation"]
    assert (step["name"], step["before"], step["kept"]) == ("strays", 1230, 1200)
    assert_array_equal(result.labels.labels, reconstruct(own, model, resolution=16).labels.labels)
    with pytest.warns(SizeWarning, match="the visible part is 0.[5-9][0-9]* m long"):
        read("all", cloud, [0.1, 0.2], keep_all=True)
    assert "strays:" not in capsys.readouterr().out
    assert read_json(tmp_path / "all/summary.json")["points"] == 1230
    for keep_all, strays in ((False, 30), (True, 0)):  # a stream counts them
        isolation = IsolationConfig(keep_all=keep_all)
        stream_reconstructions(StreamCommand(str(tmp_path), weights="any", resolution=16, isolation=isolation))
        assert json.loads(capsys.readouterr().out)["strays"] == strays


def test_every_public_name_exists_and_importing_the_package_loads_nothing() -> None:
    for name in mereo.__all__:
        assert getattr(mereo, name) is not None
    assert set(mereo.__all__) <= set(dir(mereo))
    with pytest.raises(AttributeError, match="module 'mereo' has no attribute 'reconstrukt'"):
        mereo.reconstrukt  # noqa: B018
    code = "import sys, mereo; print(sorted({'torch', 'numpy', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


__all__ = ["loads"]  # a fixture


def test_each_frame_of_a_folder_gets_what_it_gets_alone(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture
) -> None:
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    (folder / "notes.md").write_text("no frame")
    (folder / ".hidden.npy").touch()
    assert run(folder, "--output", tmp_path / "all") == 4, "the network alone"
    assert loads == ["any"]
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == ["a", "b"]
    said = capsys.readouterr().out
    assert f"[1/2] {folder / 'a.npy'}\n" in said and f"[2/2] {folder / 'b.npy'}, " in said and "2 frames" in said
    assert run(folder / "b.npy", "--output", tmp_path / "one") == 4
    assert content(tmp_path / "one") == content(tmp_path / "all/b")


def test_a_bad_frame_is_its_own(tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture) -> None:
    folder = frames(tmp_path / "frames", "good.npy")
    (folder / "bad.ply").write_text("nonsense")
    assert run(folder, tmp_path / "missing.npy", "--output", tmp_path / "out") == 2
    printed = capsys.readouterr()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good"]
    first, second, last = (line for line in printed.err.splitlines() if line.startswith("mereo: error: "))
    assert "bad.ply cannot be read as a point cloud" in first and "missing.npy" in second
    assert "2 of 3 frames could not be reconstructed" in last
    rows = [line for line in printed.out.splitlines() if "bad.ply" in line or "missing.npy" in line]
    assert all("none" in row for row in rows[2:]) and len(rows) == 4, "a heading and a row of the table each"


def test_results_that_are_there_are_kept_without_force(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture
) -> None:
    folder = frames(tmp_path / "frames", "a.npy")
    out = tmp_path / "out"
    (out / "a").mkdir(parents=True)
    (out / "a/mine.txt").write_text("keep")
    for options, sentence in (((), "exists and is not empty"), (("--force",), "not written by this version of mereo")):
        assert run(folder, "--output", out, *options) == 2 and sentence in capsys.readouterr().err
    assert [path.name for path in (out / "a").iterdir()] == ["mine.txt"]


def test_what_is_no_frames_fault_stops_before_the_work(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture
) -> None:
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    out = tmp_path / "out"
    for options, sentence in (
        (("--carry-frame", "scene"), "nothing is carried"),
        (("--carry", tmp_path / "no.stl"), "no.stl"),
        (("--scene", tmp_path / "no.yaml", "--method", "modes"), "no.yaml"),
    ):
        assert run(folder, "--output", out, *options) == 2
        printed = capsys.readouterr()
        assert sentence in printed.err and printed.err.count("\n") == 1 and not out.exists(), printed.err
    out.mkdir()
    (out / MARKER).write_text("{}")
    (tmp_path / "empty").mkdir()
    for inputs, sentence in (
        ((folder,), "is a folder of results; each frame gets a folder of its own"),
        ((), "no input is given; name a frame"),
        ((tmp_path / "empty",), "has no depth images or point clouds"),
    ):
        assert run(*inputs, "--output", out) == 2 and sentence in capsys.readouterr().err


def test_folders_are_called_by_as_much_of_the_name_as_tells_frames_apart(tmp_path: Path) -> None:
    names = lambda *files: many.folder_names([tmp_path / file for file in files])  # noqa: E731
    assert names("one/a.ply", "one/b.ply") == ["a", "b"]
    assert names("one/a.ply", "one/a.npy") == ["a.ply", "a.npy"]
    assert names("one/a.ply", "two/a.ply") == ["one-a.ply", "two-a.ply"]
    with pytest.raises(ValueError, match=r"would both be written to 'one-a.ply': reconstruct them one at a time"):
        names("x/one/a.ply", "y/one/a.ply")
    with pytest.raises(ValueError, match="would both"):
        names("one/a.ply", "one/A.ply")
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    assert many.list_frames([folder / "b.npy", folder], InputConfig()) == [folder / "b.npy", folder / "a.npy"]
