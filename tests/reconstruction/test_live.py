"""`mereo stream` on a recorded sequence of a deforming object, thirty frames a second."""

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_files import write_camera
from PIL import Image
from written_results import segments

from mereo import __main__ as command_line
from mereo.cli.answers import StreamCommand
from mereo.cli.stream import SurfaceFolder, stream_reconstructions
from mereo.evaluation.sample_views import load_view
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import inverse_rigid
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.stream import Outcome, StreamFrame, frames_of
from mereo.scenes.parameters import parameters, random_state, set_value
from mereo.scenes.registry import load_scene
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

FRAMES, BAD, RATE_HZ = 12, 5, 30.0
UNIT_M = 0.005


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[SegmentedMesh]]:
    """A rope that swings at one joint in half a second, as depth images, one of them damaged; and the truth."""
    folder = tmp_path_factory.mktemp("sequence")
    scene, rng = load_scene("rope"), np.random.default_rng(0)
    played = random_state(scene, 1_000_003)
    parameter = next(f for f in parameters(played) if f.high > f.low)
    camera = Camera.from_fov(96, 96, scene.workspace.fov_rad)
    T_camera_world = None
    truth = []
    for number in range(FRAMES):
        share = 0.3 + 0.4 * number / FRAMES
        state = set_value(scene, played, parameter, parameter.low + share * (parameter.high - parameter.low))
        mesh = scene.deform(state.deformations).mesh
        if T_camera_world is None:
            T_camera_world = inverse_rigid(scene.workspace.sample(rng, mesh.bounds.mean(axis=0)))
        truth.append(mesh.transformed(T_camera_world))
        depth = add_depth_noise(render_depth(truth[-1], camera), 0.1, rng)
        write_depth(folder / f"{number:03}.png", depth)
    (folder / f"{BAD:03}.png").write_bytes(b"\x89PNG cut off")
    write_camera(folder / "camera.json", camera)
    return folder, truth


def write_depth(path: Path, depth: DepthImage) -> None:
    """Tenths of millimetres in 16 bits."""
    Image.fromarray(np.rint(depth.depth * UNIT_M * 10_000).astype(np.uint16)).save(path)


def read(folder: Path) -> InputConfig:
    return InputConfig(intrinsics=folder / "camera.json", depth_scale=10_000.0)


def test_every_frame_is_answered_but_the_bad_one(
    sequence: tuple[Path, list[SegmentedMesh]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, truth = sequence
    command = StreamCommand(
        str(folder), weights="rope", resolution=24, every_frame=True, reading=read(folder), surfaces=tmp_path / "glb"
    )
    summary = stream_reconstructions(command)
    assert (summary.answered, summary.failed, summary.dropped) == (FRAMES - 1, 1, 0)
    out, err = capsys.readouterr()
    lines = [json.loads(text) for text in out.splitlines()]
    assert [one["frame"] for one in lines] == [f"{number:03}.png" for number in range(FRAMES)]
    assert "error" in lines[BAD] and f"{BAD:03}.png" in lines[BAD]["error"]
    assert len(list((tmp_path / "glb").iterdir())) == FRAMES - 1
    assert f"{FRAMES - 1} frames answered at" in err and "1 bad" in err
    # the base of the rope is found where it is, in metres
    base = truth[0].segments[0].vertices.mean(axis=0) * UNIT_M
    found = np.array([one["segments"]["base"]["centroid"] for one in lines if "segments" in one])
    assert np.median(np.linalg.norm(found - base, axis=1)) < 0.02


def test_at_its_recorded_pace_the_latest_frame_wins(
    sequence: tuple[Path, list[SegmentedMesh]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = sequence
    summary = stream_reconstructions(
        StreamCommand(str(folder), weights="rope", resolution=24, rate=RATE_HZ, reading=read(folder))
    )
    assert summary.answered + summary.failed + summary.dropped == FRAMES
    lines = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert lines[-1]["frame"] == f"{FRAMES - 1:03}.png"
    times = [one["time_s"] for one in lines]
    assert times == sorted(times)
    assert lines[-1]["time_s"] == pytest.approx((FRAMES - 1) / RATE_HZ)


def test_names_on_standard_input_are_frames(
    sequence: tuple[Path, list[SegmentedMesh]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = sequence
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{folder / '000.png'}\n\n{folder / '001.png'}\n"))
    frames = list(frames_of("-", read(folder), IsolationConfig()))
    assert [Path(frame.name).name for frame in frames] == ["000.png", "001.png"]
    assert len(frames[1].load().cloud) > 32


def damaged_clouds(folder: Path, cloud: np.ndarray) -> set[str]:
    """Write files that no reader can make anything of, and clouds that show nothing; returns their names."""
    np.save(folder / "1 equal.npy", np.ones((500, 3)))
    np.save(folder / "1 one point.npy", np.ones((1, 3)))
    np.save(folder / "1 no number.npy", np.full((500, 3), np.nan))
    whole, archive = (folder / "0.npy").read_bytes(), io.BytesIO()
    np.savez(archive, points=cloud)
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1" + b"0" * 30 + b", 3), }"
    for name, content in {
        "empty": b"",
        "header cut": whole[:40],
        "data cut": whole[:300],
        "header of brackets": whole[:30] + b"(" * 30 + whole[60:],
        "endless": whole[:10] + shape.ljust(118) + whole[128:],
        "archive cut": archive.getvalue()[:500],
    }.items():
        (folder / f"1 {name}.npy").write_bytes(content)
    return {file.name for file in folder.glob("1 *")}


def test_no_damaged_frame_ends_a_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = load_view("rope").depth.to_points().points
    np.save(tmp_path / "0.npy", cloud)
    np.save(tmp_path / "2.npy", cloud)
    bad = damaged_clouds(tmp_path, cloud)
    summary = stream_reconstructions(StreamCommand(str(tmp_path), weights="rope", resolution=24, every_frame=True))
    assert (summary.answered, summary.failed) == (2, len(bad))
    lines = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert {one["frame"] for one in lines if "error" in one} == bad
    assert all("\n" not in one["error"] for one in lines if "error" in one)


def test_a_file_is_no_place_for_surfaces(tmp_path: Path) -> None:
    """Which is said before the weights are loaded and any frame is answered."""
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="file is a file; surfaces are written into a folder: choose another"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="none", surfaces=tmp_path / "file"))


def test_a_sequence_that_breaks_off_is_told_after_its_frames_and_their_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def frames(*_: object) -> Iterator[StreamFrame[PointCloud]]:
        yield StreamFrame("first", 0.0, lambda: PointCloud(np.ones((40, 3))))
        raise ValueError("it is cut off")

    monkeypatch.setattr("mereo.cli.stream.frames_of", frames)
    with pytest.raises(ValueError, match="^it is cut off$"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="rope"))
    out, err = capsys.readouterr()
    assert json.loads(out)["frame"] == "first" and "1 bad" in err


def test_sources_that_are_none_are_refused(tmp_path: Path) -> None:
    reading, isolation = InputConfig(), IsolationConfig()
    with pytest.raises(FileNotFoundError, match="does not exist; a folder of frames"):
        frames_of(str(tmp_path / "nowhere"), reading, isolation)
    with pytest.raises(ValueError, match="has no depth images or point clouds"):
        frames_of(str(tmp_path), reading, isolation)
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(ValueError, match="is a single file"):
        frames_of(str(tmp_path / "a.ply"), reading, isolation)
    with pytest.raises(ValueError, match="the rate is 0"):
        frames_of(str(tmp_path), reading, isolation, 0)
    with pytest.raises(ValueError, match="none of the 1 frames could be answered"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="rope"))


def run(monkeypatch: pytest.MonkeyPatch, surfaces: Path, frames: tuple[str, ...], *more: str) -> int:
    """Exit code of a stream in which every frame is answered with the same surfaces."""
    answered = SimpleNamespace(surfaces=segments())
    outcomes = [Outcome(name, 0.0, answered, "", 0.1, 0.1, 0) for name in frames]
    nothing = SimpleNamespace(network=None, registrar=lambda _: None)
    monkeypatch.setattr("mereo.cli.stream.loaded_object", lambda *_: nothing)
    monkeypatch.setattr("mereo.cli.stream.Answering", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr("mereo.cli.stream.stream", lambda *_, **__: iter(outcomes))
    monkeypatch.setattr("mereo.cli.stream.line", lambda outcome: {"error": outcome.error})
    return command_line.main(["stream", "-", "--weights", "rope", "--surfaces", str(surfaces), *more])


def test_a_stream_replaces_no_surfaces_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.npy.glb").write_text("precious")
    (out / "thesis.tex").write_text("precious")
    assert run(monkeypatch, out, ("a.npy", "b.npy")) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"mereo: error: {out} exists and is not empty; nothing in it is overwritten")
    assert not said.out and {path.name for path in out.iterdir()} == {"a.npy.glb", "thesis.tex"}
    assert run(monkeypatch, out, ("a.npy", "b.npy"), "--force") == 0
    assert {path.name for path in out.iterdir()} == {"a.npy.glb", "b.npy.glb", "thesis.tex"}
    assert (out / "a.npy.glb").read_bytes()[:4] == b"glTF" and (out / "thesis.tex").read_text() == "precious"


def test_a_frame_replaces_its_own_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, tmp_path / "out", ("c d.npy", "c d.npy", "c_d.npy")) == 0
    first, again, other = (json.loads(line)["error"] for line in capsys.readouterr().out.splitlines())
    assert (first, again) == ("", "") and other.endswith("c_d.npy.glb holds the surfaces of c d.npy: rename c_d.npy")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["c_d.npy.glb"]


def test_what_came_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = SurfaceFolder(tmp_path, force=False)
    (tmp_path / "a.npy.glb").write_text("precious")
    outcome = Outcome("a.npy", 0.0, SimpleNamespace(surfaces=segments()), "", 0.1, 0.1, 0)
    assert "exists; it is not overwritten" in folder.written(outcome, "camera").error  # type: ignore[arg-type]
    assert (tmp_path / "a.npy.glb").read_text() == "precious"
