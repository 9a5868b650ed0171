"""Objects without weights: meshes and a frame are enough, and bad input is one sentence."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import trimesh
from angle import write_angle
from fit_cases import seen
from folder_contents import read_json, run_mereo
from numpy import ndarray
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import mereo
from mereo import __main__ as command_line
from mereo.cli.answers import ReconstructCommand, StreamCommand
from mereo.cli.options import loaded_object
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import Scores, grid_confusion, intersection_over_union, labels_on, truth_grid
from mereo.geometry.transforms import rigid as rigid_transform
from mereo.io.config import InputConfig
from mereo.io.mesh_formats import MeshWarning
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import ClustersWarning
from mereo.scenes.files.deformation_blocks import WORDS, AnyDeformation
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import CACHE_VARIABLE, CacheWarning, kept_model
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_serving.answering import Answerer
from mereo_serving.messages import JSON, FrameRequest, Served, Setup
from mereo_viewer.server import OpenPage

BOX = trimesh.creation.box()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an angle of two unequal arms, in millimetres, and what is made of it."""
    found = tmp_path_factory.mktemp("angle")
    write_angle(found)
    return found


@pytest.fixture(scope="module")
def meshes(folder: Path) -> list[str]:
    return [str(folder / "long.stl"), str(folder / "short.stl")]


@pytest.fixture(scope="module", autouse=True)
def _own_cache(folder: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(CACHE_VARIABLE, str(folder / "cache"))
        yield


@pytest.fixture(scope="module")
def angle(meshes: list[str]) -> mereo.Object:
    return mereo.load_object(meshes, units="mm")


@pytest.fixture(scope="module")
def scene(angle: mereo.Object) -> Scene:
    assert angle.scene is not None
    return angle.scene


@pytest.fixture(scope="module")
def points(scene: Scene, folder: Path) -> ndarray:
    """View of the angle in a random state, in metres; also in ``frame.npy``."""
    assert scene.unit_m is not None
    seen = sample_view(scene, GenerateConfig(), example_rng(1000, 2)).depth.to_points().points * scene.unit_m
    np.save(folder / "frame.npy", seen)
    return seen


@pytest.fixture(scope="module")
def found(angle: mereo.Object, points: ndarray) -> mereo.Result:
    return mereo.reconstruct(points, angle, resolution=48, label_points=True, unit_m=1.0)


def test_meshes_are_found_with_their_hidden_side(found: mereo.Result, scene: Scene) -> None:
    view = sample_view(scene, GenerateConfig(), example_rng(1000, 2))
    assert scene.unit_m is not None
    truth = truth_grid(view.mesh.with_vertices([scene.unit_m * part.vertices for part in view.mesh.segments]), 40)
    scores = intersection_over_union(grid_confusion(truth, labels_on(found.surfaces, truth.grid), 2))
    assert scores.iou > 0.9 and scores.miou > 0.85
    assert found.located_by == "search" and found.known is True and found.model is None


def test_it_has_names_and_colours_of_the_meshes_and_no_confidence(found: mereo.Result, angle: mereo.Object) -> None:
    assert found.names == angle.names == ("long", "short")
    assert angle.network is None and angle.model is not None and found.surfaces.colors == angle.model.rest.colors
    assert all(np.isnan(segment.confidence) for segment in found) and not found.reconstruction.calibrated
    assert "confidence" not in repr(found["long"]) and "confidence" not in found._repr_html_()


def test_what_is_written_leaves_out_what_nobody_knows(found: mereo.Result, tmp_path: Path) -> None:
    found.save(tmp_path / "out", formats=["json", "points"])
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["weights"] is None and summary["registration"]["located_by"] == "search"
    assert [one["confidence"] for one in summary["segments"]] == [None, None] and "device" not in summary
    written = (tmp_path / "out/points.ply").read_bytes()
    assert b"label" in written and b"confidence" not in written and b"occupancy" not in written


def test_the_model_is_made_once_and_read_again(folder: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    (path,) = (folder / "cache/models").iterdir()
    first = kept_model(scene)
    monkeypatch.setattr("mereo.scenes.random_states.scene_model", None)
    again = kept_model(scene)
    assert_array_equal(first.modes, again.modes)
    monkeypatch.undo()
    path.write_bytes(path.read_bytes()[:100])  # damaged: made anew, with the same bits
    assert_array_equal(kept_model(scene).modes, first.modes)


def test_a_cache_that_cannot_be_used_is_named_and_what_it_holds_is_never_waited_for(
    folder: Path, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (kept,) = (folder / "cache/models").iterdir()
    model = kept_model(scene)
    monkeypatch.setattr("mereo.scenes.random_states.scene_model", lambda *_: model)
    (tmp_path / "file").touch()
    (tmp_path / "broken").symlink_to("nothing")
    os.mkfifo(tmp_path / "pipe")
    places = {f"{tmp_path / name}": f"cannot be kept \\(.*{name}.*\\), and" for name in ("file", "broken", "pipe")}
    for name in ("a", "b", "c"):
        (tmp_path / name / "models").mkdir(parents=True)
    os.mkfifo(tmp_path / "a/models" / kept.name)
    (tmp_path / "b/models" / kept.name).mkdir()
    (tmp_path / "c/models" / kept.name).symlink_to("/dev/zero")
    places |= {f"{tmp_path / name}": f"cannot be kept \\(.*{kept.name} is a" for name in ("a", "b", "c")}
    for place, expected in (places | {"/dev/zero": "cannot be kept .*/dev/zero"}).items():
        monkeypatch.setenv(CACHE_VARIABLE, place)
        with pytest.warns(CacheWarning, match=expected) as caught:
            assert_array_equal(kept_model(scene).modes, model.modes)
        text = str(caught[0].message)
        assert "--output" not in text and text.endswith("with MEREO_CACHE") and len(caught) == 1
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "new"))  # made
    kept_model(scene)
    assert (tmp_path / "new/models" / kept.name).read_bytes() == kept.read_bytes()


def test_weights_that_are_missing_are_refused_before_the_work(
    meshes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mereo.api.objects.scene_of_meshes", None)
    with pytest.raises(FileNotFoundError, match="there are no weights 'nothing'"):
        mereo.load_object(meshes, weights="nothing")


@pytest.mark.slow
def test_what_is_said_of_a_file_is_said_once(tmp_path: Path) -> None:
    faces = "".join(
        f"usemtl m{number % 2}\nf {' '.join(map(str, face + 1))}\n" for number, face in enumerate(BOX.faces)
    )
    (tmp_path / "box.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in BOX.vertices) + faces)
    with pytest.warns(MeshWarning, match="box.obj has 2 materials, which are no closed parts") as caught:
        assert scene_of_meshes([tmp_path / "box.obj"], "m").rest.names == ("box",)
    assert len(caught) == 1


def test_a_tracker_begins_with_a_search_and_follows(angle: mereo.Object, points: ndarray) -> None:
    tracker = mereo.Tracker(angle)
    first, second = (tracker.follow(points, 0.03 * step, unit_m=1.0) for step in range(2))
    assert (first.tracked, second.tracked) == (False, True)
    assert first.located_by == second.located_by == "search"


def test_an_initial_pose_takes_the_place_of_a_search(
    found: mereo.Result, angle: mereo.Object, points: ndarray, meshes: list[str], tmp_path: Path
) -> None:
    again = mereo.reconstruct(points, angle, resolution=24, unit_m=1.0, initial_pose=found.pose)
    assert again.located_by == "pose" and again.pose is not None and found.pose is not None
    size = np.ptp(found.surfaces.merged()[0], axis=0).max()
    assert np.abs(again.surfaces.merged()[0] - found.surfaces.merged()[0]).max() < 0.1 * size
    found.save(tmp_path / "first", formats=["json"])
    np.save(tmp_path / "frame.npy", points)
    given = ["--unit-m", "1", "--initial-pose", str(tmp_path / "first/summary.json"), "--output", str(tmp_path / "out")]
    objects = ["--object", *meshes, "--units", "mm", "--resolution", "24"]
    assert run_mereo("reconstruct", tmp_path / "frame.npy", *objects, *given) in (0, 3, 4)
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["registration"]["located_by"] == "pose"
    assert_allclose(summary["pose"], again.pose, atol=1e-4)
    with pytest.raises(ValueError, match="the length of the frame's or of the object's unit is not known"):
        mereo.reconstruct(points, angle, initial_pose=found.pose)
    for wrong in (np.eye(3), 2 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)):
        with pytest.raises(ValueError, match=r"the pose is .*, and must be 4 x 4 finite numbers: a rotation and a"):
            mereo.reconstruct(points, angle, unit_m=1.0, initial_pose=wrong)


def test_a_mesh_file_is_a_frame_that_no_camera_saw(
    scene: Scene, meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """In millimetres around the origin, as CT has it: extent, pose and surfaces come out in the file's frame."""
    vertices, faces, _ = scene.rest.merged()
    assert scene.unit_m is not None
    turn = Rotation.from_euler("xyz", [100, 20, -60], degrees=True).as_matrix()
    moved = 1e3 * scene.unit_m * (vertices - vertices.mean(axis=0)) @ turn.T + np.array([5.0, -3.0, 2.0])
    trimesh.Trimesh(moved, faces, process=False).export(tmp_path / "scan.stl")
    given = ["--object", *meshes, "--units", "mm", "--resolution", "24", "--formats", "ply", "json"]
    command = [
        "reconstruct",
        str(tmp_path / "scan.stl"),
        *given,
        "--unit-m",
        "0.001",
        "--output",
        str(tmp_path / "out"),
    ]
    assert command_line.main(command) == 0
    assert "it is a surface that no single camera saw" in capsys.readouterr().out
    summary = read_json(tmp_path / "out/summary.json")
    assert summary["extent"] == "surface" and summary["recognition"]["known"] is True
    assert summary["recognition"]["signs"]["ruled_out"] == 0.0 and summary["recognition"]["signs"]["unseen"] is None
    answer = trimesh.load(tmp_path / "out/segments.ply", process=False)
    assert np.abs(np.asarray(answer.bounds) - [moved.min(axis=0), moved.max(axis=0)]).max() < 0.03 * np.ptp(moved)


def test_what_is_defined_in_the_meshes_is_carried(found: mereo.Result, scene: Scene) -> None:
    corners = found.carry(scene.rest.merged()[0], files="scene")
    assert np.abs(corners - found.surfaces.merged()[0]).max() < 0.02 * np.ptp(corners, axis=0).max()
    mesh = found.carry(scene.rest, files="scene")
    assert mesh.names == found.names and np.abs(mesh.bounds - found.surfaces.bounds).max() < 0.02 * np.ptp(mesh.bounds)
    origin, near = found.carry([[0, 0, 0]]), found.carry(np.array([[1e-9, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert_allclose(near, np.repeat(origin, 2, axis=0), atol=1e-9)  # of the files: a point like any other


def test_it_is_served_without_weights(folder: Path, meshes: list[str], points: ndarray) -> None:
    answerer = Answerer.of(Setup((Served("angle", object=tuple(meshes)),)))
    (facts,) = answerer.ready().facts
    assert (facts["scene"], facts["device"], facts["calibrated"]) == ("long", None, False)
    assert [segment["name"] for segment in facts["segments"]] == ["long", "short"]
    asked = FrameRequest("angle", folder, "frame.npy", InputConfig(unit_m=1.0), IsolationConfig(), 24, JSON)
    reply = answerer(asked)
    assert reply.status == 200 and json.loads(reply.body)["registration"]["located_by"] == "search"


def test_its_frame_and_its_result_are_shown(
    found: mereo.Result, folder: Path, meshes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    monkeypatch.setattr(OpenPage, "stay", lambda page, _: opened.append(page) or page)  # type: ignore[func-returns-value]
    found.save(tmp_path / "out")
    assert (tmp_path / "out/state.json").is_file()
    frame = [str(folder / "frame.npy"), "--unit-m", "1", "--resolution", "24", "--object", *meshes, "--units", "mm"]
    for shown in (frame, [str(tmp_path / "out")]):
        assert run_mereo("view", *shown, "--port", "0") == 0
        opened.pop().close()


def test_without_a_frame_its_laboratory_opens(meshes: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    page = OpenPage(SimpleNamespace(get_port=lambda: 1, stop=lambda: None))
    monkeypatch.setattr(OpenPage, "stay", lambda page, _: page)
    monkeypatch.setattr("mereo.api.view.open_laboratory", lambda *given: opened.append(given[:3]) or page)
    assert run_mereo("view", "--object", *meshes, "--units", "mm") == 0
    scene, network, registrar = opened[0]
    assert scene.rest.names == registrar.model.rest.names and network is None and registrar.network is None


def test_a_mesh_without_volume_is_a_sentence(tmp_path: Path) -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    flat.export(tmp_path / "flat.stl")
    with pytest.raises(ValueError, match="flat.stl is flat, without any volume; an object's parts are solids: name a"):
        mereo.load_object(tmp_path / "flat.stl")
    tilted = trimesh.Trimesh([[0, 0, 0], [90, 0, 10], [0, 60, 20], [70, 70, 70]], [[0, 1, 2], [1, 3, 2]], process=False)
    tilted.export(tmp_path / "tilted.stl")
    with pytest.raises(ValueError, match=r"tilted.stl is an open surface \(4 open edges\) that encloses no"):
        mereo.load_object(tmp_path / "tilted.stl")


def test_two_objects_in_a_cloud_are_warned_of(
    angle: mereo.Object, points: ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mereo.api.reconstruct.answer_observation", None)  # which would search long
    both = np.concatenate([points, points + np.array([0.5, 0.0, 0.0])])
    sentence = "two separate clusters of like size"
    with pytest.raises(TypeError), pytest.warns(ClustersWarning, match=f"{sentence} .* if they are two, crop to one"):
        mereo.reconstruct(both, angle)


@pytest.mark.parametrize(
    "frame, unit_m, words",
    [
        ("mm.npy", "1", "correct the unit of the frame (--unit-m 0.001 for millimetres"),
        ("frame.npy", "0.001", "the object 120, a factor of 9"),
    ],
)
def test_a_wrong_unit_ends_a_command_with_a_sentence_and_nothing_written(
    frame: str,
    unit_m: str,
    words: str,
    meshes: list[str],
    points: ndarray,
    working_folder: Path,
    capsys: pytest.CaptureFixture,
) -> None:
    np.save("frame.npy", points), np.save("mm.npy", 1000 * points)
    before = set(Path().iterdir())
    given = ["reconstruct", frame, "--object", *meshes, "--units", "mm", "--unit-m", unit_m, "--output", "out"]
    assert command_line.main(given) == 2
    text = capsys.readouterr().err
    assert text.count("mereo: error: ") == 1 and words in text and set(Path().iterdir()) == before


def test_a_network_cannot_answer_for_an_object_without(angle: mereo.Object, points: ndarray) -> None:
    with pytest.raises(ValueError, match="the method is network, but the object has no weights"):
        mereo.reconstruct(points, angle, "network")


def test_a_built_in_scene_is_named_like_a_file() -> None:
    rope = loaded_object(StreamCommand("-", object=("rope",)))
    assert rope.network is None and rope.scene is not None and rope.name == "rope"
    with pytest.raises(ValueError, match="--scene is rope, but --object says what the object is"):
        loaded_object(ReconstructCommand((), object=("rope",), scene="rope"))


def test_folders_of_meshes_and_scene_files_are_objects(folder: Path, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    for name in ("long", "short"):
        (parts / f"{name}.stl").write_bytes((folder / f"{name}.stl").read_bytes())
    known = mereo.load_object(parts, units="mm")
    assert known.names == ("long", "short") and known.scene is not None and known.scene.file is None


# --- every kind of deformation ----------------------------------------------------------------------------------------

FAR = rigid_transform(Rotation.from_euler("xyz", [25, 30, 10], degrees=True).as_matrix(), np.array([1.0, 2.0, 280.0]))
"""``T_camera_scene`` from which a camera sees the whole angle."""

MOVES = {
    "rigid": "rigid",
    "soft": "soft",
    "stiff": "stiff",
    "nothing": "[]",
    "lattice": "[{type: lattice, strength: 0.3}]",
    "waves": "[{type: waves, wavelength: [150, 200], strength: 0.2}]",
    "bend": "[{type: bend, origin: [60, 15, 12], axis: [1, 0, 0], length: 60, angle: [0, 30], toward: [0, 0, 1]}]",
    "twist": "[{type: twist, origin: [0, 15, 12], axis: [1, 0, 0], length: 120, angle: [-30, 30]}]",
    "taper": "[{type: taper, origin: [0, 15, 12], axis: [1, 0, 0], length: 120, factor: [0.7, 1.3]}]",
    "squash": "[{type: squash, factor: [0.8, 1.25], axis: [1, 0, 0]}]",
    "joint": "[{type: joint, segments: [short], pivot: [20, 30, 12], axis: [0, 0, 1], angle: [0, 25]}]",
    "push": "[{type: push, distance: [-8, 0], tip: 5, reach: 40}]",
    "elastic": "[{type: elastic, motion: 0.05, cells: 12}]",
}
"""Deformations of the angle, one of each kind that a scene file can name; a joint of the range 0 is one of a rigid
object."""

STILL = "[{type: joint, segments: [short], pivot: [20, 30, 12], axis: [0, 0, 1], angle: [0, 0]}]"


def angle_that(moves: str, folder: Path, path: Path) -> mereo.Object:
    """The angle with these deformations, by a scene file at ``path``."""
    files = "".join(f"  - {{name: {name}, file: {folder / name}.stl}}\n" for name in ("long", "short"))
    path.write_text(f"name: angle\nunits: mm\nsegments:\n{files}deformations: {moves}\n", encoding="utf-8")
    return mereo.load_object(path)


def view_of(bent: mereo.Object, number: int) -> tuple[ndarray, SegmentedMesh]:
    """View of the whole object in a random state, and that state, both in metres."""
    assert bent.scene is not None and bent.scene.unit_m is not None
    placed = bent.scene.sample_state(example_rng(1000, number)).mesh.transformed(FAR)
    true = placed.with_vertices([bent.scene.unit_m * part.vertices for part in placed.segments])
    return seen(placed) * bent.scene.unit_m, true


def scores_of(surfaces: SegmentedMesh, true: SegmentedMesh) -> Scores:
    truth = truth_grid(true, 40)
    return intersection_over_union(grid_confusion(truth, labels_on(surfaces, truth.grid), len(true.segments)))


def test_every_kind_of_deformation_is_tried() -> None:
    """A kind that is added to the schema is missing here."""
    types = {get_args(kind.model_fields["type"].annotation)[0] for kind in get_args(AnyDeformation)}
    assert set(MOVES) == types | set(WORDS) | {"nothing"}


@pytest.mark.parametrize(
    "kind", [kind if kind in ("rigid", "stiff") else pytest.param(kind, marks=pytest.mark.slow) for kind in MOVES]
)
def test_an_object_of_each_kind_of_deformation_is_reconstructed(kind: str, folder: Path, tmp_path: Path) -> None:
    bent = angle_that(MOVES[kind], folder, tmp_path / "angle.yaml")
    points, true = view_of(bent, 2)
    answer = mereo.reconstruct(points, bent, resolution=24, unit_m=1.0)
    scores = scores_of(answer.surfaces, true)
    assert answer.known is True and scores.iou > 0.85 and scores.miou > 0.8, (answer, answer.recognition, scores)


@pytest.mark.parametrize("moves", ["rigid", "[]", STILL], ids=["rigid", "nothing", "still joint"])
def test_a_rigid_object_is_placed_exactly_by_every_way(moves: str, folder: Path, tmp_path: Path) -> None:
    rigid = angle_that(moves, folder, tmp_path / "angle.yaml")
    assert rigid.model is not None and rigid.model.count == 0
    points, true = view_of(rigid, 0)
    answers = [mereo.reconstruct(points, rigid, resolution=24, unit_m=1.0)]
    answers.append(mereo.reconstruct(points, rigid, resolution=24, unit_m=1.0, initial_pose=answers[0].pose))
    tracker = mereo.Tracker(rigid)
    answers += [tracker.follow(points, 0.03 * step, unit_m=1.0) for step in range(2)]
    longest = np.ptp(true.merged()[0], axis=0).max()
    for answer in answers:
        assert answer.known is True and answer.registration is not None and answer.registration.accepted, answer
        assert np.abs(answer.surfaces.merged()[0] - true.merged()[0]).max() < 1e-3 * longest, answer
    assert [answer.tracked for answer in answers[-2:]] == [False, True]
    corners = answers[0].carry([[1.0, 1.0, 1.0], [119.0, 1.0, 1.0]])
    assert norm(corners[1] - corners[0]) == pytest.approx(0.118, rel=1e-3)


def test_a_rigid_object_of_unknown_unit_is_found_with_its_size(folder: Path, tmp_path: Path) -> None:
    rigid = angle_that("rigid", folder, tmp_path / "angle.yaml")
    points, true = view_of(rigid, 1)
    answer = mereo.reconstruct(3.0 * points, rigid, resolution=24)
    assert np.abs(answer.surfaces.merged()[0] / 3.0 - true.merged()[0]).max() < 1e-3 * np.ptp(points, axis=0).max()


@pytest.mark.slow
def test_what_explains_half_of_the_points_is_not_believed(folder: Path, tmp_path: Path) -> None:
    """The object, and the same cloud 1.35 times as far away behind it: neither unit nor place is certain."""
    rigid = angle_that("rigid", folder, tmp_path / "angle.yaml")
    points, _ = view_of(rigid, 1)
    with pytest.warns(ClustersWarning):
        answer = mereo.reconstruct(np.concatenate([points, 1.35 * points]), rigid, resolution=24)
    assert answer.registration is not None and not answer.registration.accepted and answer.known is not True
