"""`mereo stream --rerun`: the recording that is written holds what was answered, and refusals are one sentence."""

import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mereo.cli.answers import StreamCommand
from mereo.cli.stream import CURVES, FrameAnswer, RerunTarget, messages, series, stream_reconstructions
from mereo.fitting.registration.recognition import Recognition
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.stream import Outcome
from mereo.scenes.registry import load_scene
from mereo.synthesis.config import SENSORS, SequenceConfig
from mereo.synthesis.recording import CAMERA, FRAMES, write_recording

RERUN = "rerun-sdk is not installed: pip install 'mereo[rerun]'"

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
CAMERA_3X2 = Camera(3, 2, 4.0, 5.0, 1.5, 1.0)
KNOWN, UNSURE = Recognition(True, None, 0.0), Recognition("unsure", "the camera looked away", 4.0)
DEPTH = np.array([[0.0, 1.0, 2.0], [1.5, 0.0, 3.0]])


def tetrahedron(name: str, size: float = 1.0, color: tuple[int, int, int] = (10, 20, 30)) -> Segment:
    return Segment(name, color, size * CORNERS, FACES)


def empty(name: str) -> Segment:
    return Segment(name, (1, 2, 3), np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))


def answer(*segments: Segment, tracked: bool = True, recognition: Recognition = KNOWN) -> FrameAnswer:
    image = DepthImage(DEPTH, CAMERA_3X2)
    cloud = image.to_points()
    frame = SensorFrame(Path("a.png"), cloud, 1.0, "camera", image)
    reading = Reading(cloud, np.array([True, True, False, True]))
    mesh, seen = SegmentedMesh(segments), Observation(frame, cloud)
    radii = {"median": 0.5, "max": 2.5, "calibrated": True}
    return FrameAnswer(
        mesh, {}, reading, "modes", "followed" if tracked else "found", 0.75, recognition, radii, seen, 0.05
    )


def outcome(number: int, result: FrameAnswer | None, error: str = "") -> Outcome[FrameAnswer]:
    return Outcome(f"{number}.png", number / 8, result, error, 0.1, 0.07, dropped=number)


Rows = dict[str, list[tuple[float, Any]]]
"""What a recording holds of each entity and component: pairs of time in seconds (NaN where it is for ever), value."""


def read_rows(path: Path) -> Rows:
    chunk = pytest.importorskip("rerun.chunk", reason=RERUN)
    found: Rows = {}
    for one in chunk.RrdReader(path).stream().to_chunks():
        table = one.to_record_batch()
        names = table.schema.names
        nanoseconds = table.column("frame_time").cast("int64").to_numpy() if "frame_time" in names else None
        times = np.full(len(table), np.nan) if nanoseconds is None else nanoseconds / 1e9
        for name in (name for name in names if ":" in name):
            values = table.column(name).to_pylist()
            rows = [(float(time), value) for time, value in zip(times, values, strict=True) if value is not None]
            found.setdefault(f"{one.entity_path} {name}", []).extend(rows)
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in found.items()}


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """Five frames: one of two segments, one in which a segment is gone, a bad one, and two more."""
    pytest.importorskip("rerun", reason=RERUN)
    path = tmp_path_factory.mktemp("log") / "stream.rrd"
    both = answer(tetrahedron("left ear"), tetrahedron("a/b", 2.0), tracked=False)
    with RerunTarget(str(path)).opened("frames", "camera") as log:
        log.add(outcome(0, both))
        log.add(outcome(1, answer(tetrahedron("left ear", 3.0), empty("a/b"), recognition=UNSURE)))
        log.add(outcome(2, None, "2.png is damaged: record it again"))
        log.add(outcome(3, answer(tetrahedron("left ear", 4.0), tetrahedron("a/b"))))
        log.add(outcome(4, answer(tetrahedron("left ear", 5.0), tetrahedron("a/b"))))
        assert not path.exists()  # it appears whole
    return read_rows(path)


def test_meshes_are_the_segments_at_the_frames_times(rows: Rows) -> None:
    places = rows["/object/left\\ ear Mesh3D:vertex_positions"]
    assert [time for time, _ in places] == [0.0, 0.125, 0.375, 0.5]
    for (_, place), size in zip(places, (1.0, 3.0, 4.0, 5.0), strict=True):
        np.testing.assert_allclose(place, size * CORNERS)
    (_, color), *_ = rows["/object/left\\ ear Mesh3D:albedo_factor"]
    assert color == [10 << 24 | 20 << 16 | 30 << 8 | 255]
    normals = np.array(rows["/object/left\\ ear Mesh3D:vertex_normals"][0][1])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-6)
    assert normals[0] @ np.ones(3) < 0  # outward


def test_faces_are_written_once_and_again_after_they_were_cleared(rows: Rows) -> None:
    faces = rows["/object/left\\ ear Mesh3D:triangle_indices"]
    assert [time for time, _ in faces] == [0.0, 0.375]
    np.testing.assert_array_equal(faces[1][1], FACES)
    # gone in the second frame, cleared with all others in the third, back in the fourth
    assert [time for time, _ in rows["/object/a\\/b Clear:is_recursive"]] == [0.125]
    assert [time for time, _ in rows["/object/a\\/b Mesh3D:vertex_positions"]] == [0.0, 0.375, 0.5]
    for entity in ("cloud", "strays", "camera/depth", "object"):
        assert rows[f"/{entity} Clear:is_recursive"] == [(0.25, [True])]


def test_depth_image_and_points_are_the_frames(rows: Rows) -> None:
    image = np.frombuffer(bytes(rows["/camera/depth DepthImage:buffer"][0][1][0]), np.float32)
    np.testing.assert_array_equal(image.reshape(DEPTH.shape), DEPTH)
    ((_, matrix),) = rows["/camera Pinhole:image_from_camera"]  # once, as it stays
    np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, [[4, 0, 1.5], [0, 5, 1], [0, 0, 1]])
    seen = DepthImage(DEPTH, CAMERA_3X2).to_points().points
    np.testing.assert_allclose(rows["/cloud Points3D:positions"][0][1], seen[[0, 1, 3]])
    np.testing.assert_allclose(rows["/strays Points3D:positions"][0][1], seen[[2]])
    ((time, axes),) = rows["/ ViewCoordinates:xyz"]
    assert np.isnan(time) and axes == [[3, 2, 5]]  # right, down, forward


def test_numbers_and_sentences_are_those_of_the_answers(rows: Rows) -> None:
    def curve(name: str) -> list[tuple[float, float]]:
        return [(time, value) for time, (value,) in rows[f"/{name} Scalars:scalars"]]

    assert curve("answer/explained") == [(time, 0.75) for time in (0.0, 0.125, 0.375, 0.5)]
    assert curve("answer/known") == [(0.0, 1.0), (0.125, 0.5), (0.375, 1.0), (0.5, 1.0)]
    assert curve("answer/tracked") == [(0.0, 0.0), (0.125, 1.0), (0.375, 1.0), (0.5, 1.0)]
    assert [value for _, value in curve("points/dropped_frames")] == [0, 1, 2, 3, 4]
    assert {value for _, value in curve("points/strays")} == {1}
    assert {value for _, value in curve("radius95/max")} == {2.5}
    shown = {name.split()[0].split("/")[1] for name in rows if name.endswith("Scalars:scalars")}
    assert shown == set(CURVES), "a curve that no view shows, or a view without one"
    parts = [dict(curve(f"milliseconds/{name}")) for name in ("waiting", "decoding", "answering", "latency")]
    assert sum(part[0.0] for part in parts[:3]) == pytest.approx(parts[3][0.0]) == pytest.approx(100.0)
    assert dict(curve("milliseconds/failing")) == {0.25: pytest.approx(70.0)}
    texts = [(time, text) for time, (text,) in rows["/log TextLog:text"]]
    assert texts == [
        (0.0, "0.png: the object was found; the answer is by modes"),
        (0.125, f"1.png: {UNSURE.description}"),
        (0.25, "2.png: 2.png is damaged: record it again"),
    ]
    assert [level for _, (level,) in rows["/log TextLog:level"]] == ["INFO", "WARN", "ERROR"]


def test_without_a_model_nothing_is_said_of_the_network() -> None:
    alone = FrameAnswer(SegmentedMesh((empty("a"),)), {}, Reading.of_all(PointCloud(CORNERS)), "network", "found", None)
    assert list(messages(outcome(0, alone))) == []
    assert not {"answer/explained", "answer/known"} & series(outcome(0, alone)).keys()


def test_a_scanners_frames_and_dates_are_shown_as_such(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=RERUN)
    late = Outcome("0", 1.7e9, answer(tetrahedron("a")), "", 0.1, 0.1, 0)
    with RerunTarget(str(tmp_path / "a.rrd")).opened("frames", "scanner") as log:
        log.add(late)
    rows = read_rows(tmp_path / "a.rrd")
    assert rows["/ ViewCoordinates:xyz"][0][1] == [[3, 1, 6]]  # right, up, back
    assert rows["/answer/explained Scalars:scalars"] == [(1.7e9, [0.75])]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of a moving engine, and a damaged one."""
    folder = tmp_path_factory.mktemp("walk")
    settings = SequenceConfig(seconds=4 / 30, occluder="none")
    write_recording(folder, load_scene("engine"), settings, ("paper", SENSORS["paper"]), 740_000)
    (folder / FRAMES / "0002.png").write_bytes(b"no image")
    return folder


def test_a_stream_is_recorded_as_it_is_printed(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun", reason=RERUN)
    path = tmp_path / "walk.rrd"
    summary = stream_reconstructions(StreamCommand(str(walk), weights="engine", every_frame=True, rerun=str(path)))
    lines = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert summary.answered == 3 and "error" in lines[2]
    rows, good = read_rows(path), [line for line in lines if "error" not in line]
    explained = rows["/answer/explained Scalars:scalars"]
    assert explained == [(pytest.approx(line["time_s"], abs=1e-8), [line["explained"]]) for line in good]
    assert [row[1] for row in rows["/answer/tracked Scalars:scalars"]] == [[float(line["tracked"])] for line in good]
    image = np.frombuffer(bytes(rows["/camera/depth DepthImage:buffer"][-1][1][0]), np.float32)
    written = read_frame(walk / FRAMES / "0003.png", InputConfig(intrinsics=walk / CAMERA)).depth
    assert written is not None
    np.testing.assert_allclose(image.reshape(written.depth.shape), written.depth, rtol=1e-6)
    for name, facts in good[-1]["segments"].items():
        entity = f"/object/{name.replace(' ', chr(92) + ' ')}"
        vertices = np.array(rows[f"{entity} Mesh3D:vertex_positions"][-1][1])
        faces = np.array(rows[f"{entity} Mesh3D:triangle_indices"][-1][1])
        corners = vertices[faces]
        volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert volume == pytest.approx(facts["volume"], rel=1e-3)
    error = next(line["error"] for line in lines if "error" in line)
    assert (rows["/log TextLog:text"][-1][1]) == [f"0002.png: {error}"]


def test_where_nothing_is_answered_nothing_is_recorded(walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=RERUN)
    for name in ("a", "b"):
        (tmp_path / f"{name}.ply").write_bytes(b"no cloud")
    with pytest.raises(ValueError, match="none of the 2 frames could be answered"):
        stream_reconstructions(
            StreamCommand(str(tmp_path), weights="engine", every_frame=True, rerun=str(tmp_path / "log" / "walk.rrd"))
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def refusal(error: type[Exception], act: Callable[[], object]) -> str:
    with pytest.raises(error) as found:
        act()
    return str(found.value)


def test_what_is_no_destination_is_refused_in_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=RERUN)
    there = tmp_path / "there.rrd"
    there.write_bytes(b"mine")
    assert refusal(ValueError, lambda: RerunTarget("walk.mp4")) == (
        "walk.mp4 is no place for a Rerun recording: name a file that ends in .rrd, or the address of an open viewer, "
        "rerun+http://127.0.0.1:9876/proxy"
    )
    assert "it is not overwritten: choose another name or pass --force" in refusal(
        FileExistsError, lambda: RerunTarget(str(there))
    )
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = f"rerun+http://127.0.0.1:{taken.getsockname()[1]}/proxy"
        assert refusal(OSError, lambda: RerunTarget(address)).startswith(
            f"no Rerun viewer can be reached at {address} ("
        )
    with RerunTarget(str(there), force=True).opened("frames", "camera") as log:
        log.add(outcome(0, answer(tetrahedron("a"))))
    assert "/object/a Mesh3D:vertex_positions" in read_rows(there)


def test_without_the_sdk_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert refusal(ImportError, lambda: RerunTarget(str(tmp_path / "walk.rrd"))) == (
        "the Rerun SDK, which --rerun needs, is not installed: run pip install 'mereo[rerun]'"
    )
