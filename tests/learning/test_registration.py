"""``mereo align``: segments are placed on a scan one by one, by a start file, and evaluation takes the truth."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticModel, oracle
from folder_contents import read_json
from numpy import ndarray
from numpy.linalg import det, inv, norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scene_files import write_bar
from scipy.spatial.transform import Rotation
from shapes import ball, box

from mereo.__main__ import main
from mereo.geometry.camera import VIEW_DISTANCE, Camera, into_camera
from mereo.geometry.conventions import Range
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Normalizer, inverse_rigid, rigid, transform_points, unit_rows
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.depth_sensor import render_depth
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.icp import Matches, Registration, Scan, exposed, icp, moved
from mereo_learning.placement import Placement, Start, _check, place, read_start
from mereo_learning.scans import (
    BUNNY_SCAN_POSES,
    SCANS,
    bunny_posed,
    bunny_scan,
    bunny_truth,
    read_truth,
    scan_in_camera,
)
from mereo_learning.scoring import EvaluationConfig, evaluate
from mereo_objects.bunny import model_to_scene

CAMERA = Camera.from_fov(160, 160, float(np.deg2rad(30.0)))
NOISE = 0.02
Bar, Require = tuple[Path, Scene, ndarray], Callable[[str], Path]


def object_at_rest() -> SegmentedMesh:
    """A base, an arm beside it, and a peg behind the base (farther along z)."""
    base, arm = box((0, 0, 0), (20, 12, 8), "base"), box((21, 2, 1), (38, 9, 7), "arm", 1)
    return SegmentedMesh((base, arm, box((8, 5, 8.5), (12, 8, 11), "peg", 2)))


def true_poses() -> ndarray:
    """In a camera frame: three sides of base and arm are seen; the arm is bent away by 25 degrees."""
    turn = Rotation.from_euler("yx", [-35, 25], degrees=True).as_matrix()
    whole = rigid(turn, np.array([-8.0, -2.0, 110.0]))
    bend = Rotation.from_rotvec(np.deg2rad(25) * np.array([0.1, 0.3, 1.0])).as_matrix()
    joint = np.array([20.5, 6, 4])
    return np.stack([whole, whole @ rigid(bend, joint - bend @ joint), whole])


def scan_of(mesh: SegmentedMesh, noise: float, seed: int = 0) -> ndarray:
    """What ``CAMERA`` sees of a mesh in its frame, noise in the mesh's unit."""
    points = render_depth(mesh, CAMERA).to_points().points
    return points + default_rng(seed).normal(scale=noise, size=points.shape)


def perturbed(pose: ndarray, middle: ndarray, degrees: float, shift: float, seed: int) -> ndarray:
    """``pose``, then a turn about ``middle`` (model coordinates) and a shift, both in a random direction."""
    rng = default_rng(seed)
    axis, way = (vector / norm(vector) for vector in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    place = transform_points(pose, middle)
    return rigid(turn, place - turn @ place + shift * way) @ pose


def pose_error(found: ndarray, true: ndarray, middle: ndarray) -> Range:
    """Distance of the segment's middle from where it belongs, and the turn in degrees."""
    shift = norm(transform_points(found, middle) - transform_points(true, middle))
    turn = Rotation.from_matrix((found @ inv(true))[:3, :3])
    return float(shift), float(np.rad2deg(turn.magnitude()))


pytest.importorskip("small_gicp", reason="the extra align is not installed")


def middles() -> list[ndarray]:
    return [segment.bounds.mean(axis=0) for segment in object_at_rest().segments]


def start() -> Start:
    """The object off by 12 degrees and 4 units of its 44; the arm, which is bent, has a rough pose of its own."""
    poses = true_poses()
    whole = perturbed(poses[0], np.array([19.0, 6.0, 4.0]), 12, 4, seed=1)
    return Start(
        np.stack([whole, perturbed(poses[1], middles()[1], 10, 2, seed=2), whole]), np.array([0, 1, 0], bool), ""
    )


@pytest.fixture(scope="module")
def points() -> ndarray:
    return scan_of(moved(object_at_rest(), true_poses()), NOISE)


@pytest.fixture(scope="module")
def placement(points: ndarray) -> Placement:
    return place(object_at_rest(), points, start())


def test_each_segment_comes_to_its_own_true_pose_and_a_hidden_one_goes_with_its_neighbour(placement: Placement) -> None:
    """To a few times the noise, although base and arm are bent against each other; with one pose they would not."""
    for index in (0, 1):
        segment = placement.segments[index]
        shift, turn_deg = pose_error(segment.T_scan_segment, true_poses()[index], middles()[index])
        assert shift < 0.03 and turn_deg < 0.1
        assert segment.placed_by == "scan"
        assert segment.median < 2 * NOISE and segment.p95 < 5 * NOISE and segment.points > 500
    base, arm, peg = placement.segments
    assert (base.held, arm.held) == (0, 1), "three sides of the base are seen, two of the arm: it might slide"
    assert pose_error(base.T_scan_segment, true_poses()[1], middles()[1])[0] > 2
    assert placement.explained > 0.98
    assert arm.shift == pytest.approx(2, abs=0.05) and arm.turn_deg == pytest.approx(10, abs=0.2)
    assert peg.points == 0 and not peg.seen and peg.placed_by == "with base"
    assert_array_equal(peg.T_scan_segment, base.T_scan_segment)
    assert np.isnan(peg.median)


@pytest.mark.slow
def test_a_held_segment_is_left_to_its_neighbour_or_start(points: ndarray) -> None:
    rest = object_at_rest()
    rough = start()
    own = place(rest, points, rough, hold=["arm"]).segments[1]
    assert own.placed_by == "start"
    assert_array_equal(own.T_scan_segment, rough.poses[1])
    with pytest.raises(ValueError, match="no segment 'leg' to hold; the segments are base, arm, peg"):
        place(rest, points, rough, hold=["leg"])


@pytest.mark.slow
def test_as_one_moves_all_by_one_motion(points: ndarray) -> None:
    """What is rigid keeps its shape, whatever the scan says of its parts."""
    rest = SegmentedMesh((object_at_rest().segments[0], object_at_rest().segments[2]))
    mine = scan_of(moved(rest, true_poses()[[0, 2]]), NOISE)
    rough = Start(start().poses[[0, 2]], np.zeros(2, bool), "")
    base, peg = place(rest, mine, rough, is_rigid=True).segments
    assert base.placed_by == peg.placed_by == "object"
    assert_array_equal(base.T_scan_segment, peg.T_scan_segment)
    assert pose_error(base.T_scan_segment, true_poses()[0], middles()[0])[0] < 0.05


def test_a_scan_of_something_else_or_far_from_the_start_is_refused(points: ndarray) -> None:
    """Three points in five belong to a wall behind the object."""
    few = points[::4]
    wall = default_rng(0).uniform([-60, -60, 170], [60, 60, 171], size=(len(few) * 3 // 2, 3))
    with pytest.raises(ValueError, match="4.% of the scan's points|[0-3].% of the scan's points lie within"):
        place(object_at_rest(), np.concatenate([few, wall]), start())
    with pytest.raises(ValueError, match="the scan has 1 points that are .* apart; at least 40 are needed"):
        place(object_at_rest(), points[:1], start())
    away = start().poses.copy()
    away[:, 1, 3] += 60
    with pytest.raises(ValueError, match="segment 'base' moved by .* from its start, but at most|of the scan's points"):
        place(object_at_rest(), points, Start(away, np.zeros(3, bool), ""))


def test_a_segment_that_ran_away_is_refused() -> None:
    before, after = true_poses(), true_poses()
    after[2, :3, 3] += 4.0  # the peg is 5.6 long
    matches = Matches(np.zeros(1, int), np.zeros(1), 1.0)
    scan = Scan(np.zeros((1, 3)), np.zeros(3), 44.0, 1.0)
    moved = Registration(after, np.ones(3, bool), np.zeros(3, int), matches)
    with pytest.raises(ValueError, match="segment 'peg' moved by 6.93 .* at most 5.59, .* --hold peg"):
        _check(object_at_rest(), before, moved, scan)
    after[2, :3, 3] -= 2.0
    _check(object_at_rest(), before, moved, scan)


def test_a_ball_is_shifted_but_not_turned() -> None:
    """Its three turns are free: half of a ball, moved by a known shift, gives the shift and no turn."""
    sphere = ball((0, 0, 50), 6.0, "ball", level=4)
    shift = np.array([0.4, -0.3, 0.2])
    way = unit_rows(default_rng(0).normal(size=(3000, 3)))
    half = np.array([0.0, 0.0, 50.0]) + 6.0 * way * [1, 1, -1] + shift
    motion, held = icp(half[half[:, 2] < 50.2], SegmentedMesh((sphere,)), 1.0, 0.05, hold=True)
    assert held == 3
    assert_allclose(motion[:3, 3] + motion[:3, :3] @ [0, 0, 50] - [0, 0, 50], shift, atol=0.02)
    assert_allclose(motion[:3, :3], np.eye(3), atol=2e-3)


def test_faces_in_contact_cannot_be_seen() -> None:
    """Of two boxes that touch, exactly the two faces between them go; of a nested one, all."""
    left, right = box((0, 0, 0), (1, 1, 1), "left"), box((1, 0, 0), (2, 1, 1), "right", 1)
    shown = exposed(SegmentedMesh((left, right)))
    assert [len(segment.faces) for segment in shown.segments] == [10, 10]
    assert not (shown.segments[0].vertices[shown.segments[0].faces][..., 0] == 1).all(axis=1).any()
    inner, outer = box((1, 1, 1), (2, 2, 2), "inner"), box((0, 0, 0), (3, 3, 3), "outer", 1)
    shown = exposed(SegmentedMesh((inner, outer), (("inner", "outer"),)))
    assert [len(segment.faces) for segment in shown.segments] == [0, 12]


# --- start files: what they may say, and one sentence for each thing that they may not --------------------------------


SCALE = 2.5
TURN = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix()
POSE = rigid(SCALE * TURN, np.array([1.0, 2.0, 3.0]))
MODEL = np.array([[0.0, 0, 0], [20, 0, 0], [0, 12, 0], [30, 5, 8]])


def pairs(model: ndarray = MODEL, pose: ndarray = POSE) -> dict[str, list[list[float]]]:
    return {"model": model.tolist(), "scan": transform_points(pose, model).tolist()}


def write(folder: Path, value: object) -> Path:
    path = folder / "start.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def test_exact_pairs_and_matrices_give_the_pose_and_a_segment_may_have_its_own(tmp_path: Path) -> None:
    rest = object_at_rest()
    by_pairs = read_start(write(tmp_path, {"object": pairs()}), rest, SCALE)
    assert_allclose(by_pairs.poses, np.stack([POSE] * 3), atol=1e-9)
    assert not by_pairs.separate.any()
    by_matrix = read_start(write(tmp_path, {"object": POSE.tolist()}), rest)
    assert_allclose(by_matrix.poses[0], POSE, atol=1e-9)
    other = rigid(SCALE * np.eye(3), np.array([5.0, 6.0, 7.0]))
    start = read_start(write(tmp_path, {"object": pairs(), "segments": {"arm": pairs(pose=other)}}), rest, SCALE)
    assert start.separate.tolist() == [False, True, False]
    assert_allclose(start.poses, [POSE, other, POSE], atol=1e-9)
    assert start.how == "object; arm from start.json"


def test_the_known_scale_is_kept_and_the_middle_stays_and_a_missing_file_is_named(tmp_path: Path) -> None:
    """A matrix of a scale that is 5 % off: size from the units, place and turn from the matrix."""
    rest = object_at_rest()
    rough = rigid(1.05 * SCALE * TURN, np.array([1.0, 2.0, 3.0]))
    pose = read_start(write(tmp_path, {"object": rough.tolist()}), rest, SCALE).poses[0]
    assert_allclose(pose[:3, :3], SCALE * TURN, atol=1e-9)
    middle = rest.bounds.mean(axis=0)
    assert_allclose(transform_points(pose, middle), transform_points(rough, middle))
    with pytest.raises(FileNotFoundError, match="gone.json does not exist; a start file is needed"):
        read_start(tmp_path / "gone.json", object_at_rest())


SPREAD = np.array([[0.0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0], [0, 0, 9]])
SADDLE = SCALE * SPREAD + np.outer([-15, 15, -15, 15, 0], [0, 0, 1])
TWISTED = {"model": SPREAD.tolist(), "scan": SADDLE.tolist()}
MIRROR = POSE @ np.diag([-1.0, 1, 1, 1])


@pytest.mark.parametrize(
    "stated, scale, sentence",
    [
        ({}, SCALE, 'it has neither "object" nor "segments"'),
        ({"object": pairs(), "scale": 3}, SCALE, "has the key 'scale'; it may have"),
        ({"segments": {"leg": pairs()}}, SCALE, "start of the segment 'leg'; the segments are base, arm, peg"),
        ({"segments": {"arm": pairs()}}, SCALE, "no start for the segment 'base' and none of the object"),
        ({"object": pairs(MODEL[:2])}, SCALE, "2 points of the model and 2 of the scan; at least 3 pairs"),
        ({"object": {**pairs(), "scan": "here"}}, SCALE, "scan of the start of the object must be rows of 3 finite"),
        ({"object": pairs(np.outer([0, 1, 2, 3], [1.0, 2, 3]))}, SCALE, "lie on a line; they must span a triangle"),
        ({"object": pairs(pose=MIRROR)}, SCALE, "the pairs of the object fit a mirror image better"),
        ({"object": pairs(SPREAD), "segments": {"arm": TWISTED}}, SCALE, "pairs of segment 'arm' are 13.4 apart"),
        ({"object": pairs()}, None, "about 2.5 scan units per scene unit.: give the scene's unit with --scene-unit-mm"),
        ({"object": pairs()}, 2500.0, "has 2.5 scan units per scene unit, but the units of scene and scan give 2500"),
        ({"object": MIRROR.tolist()}, SCALE, "is a reflection"),
        ({"object": np.diag([1.0, 2, 1, 1]).tolist()}, None, "shears or stretches"),
        ({"object": POSE.T.tolist()}, SCALE, "has the last row .*; it must be 0 0 0 1: is it transposed?"),
        ({"object": pairs(pose=1e300 * POSE)}, SCALE, "finite numbers up to 1e.12"),
    ],
)
def test_bad_starts(tmp_path: Path, stated: object, scale: float | None, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_start(write(tmp_path, stated), object_at_rest(), scale)


# --- the command, the truth that it writes, and the scans of the bunny ------------------------------------------------


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Bar:
    """A folder with scan.npy (mm), bar.yaml and what ``mereo align`` wrote to truth/; the scene, and the true pose."""
    folder = tmp_path_factory.mktemp("bar")
    path = write_bar(folder)
    scene = load_scene(path)
    assert scene.unit_m is not None
    low, high = scene.rest.bounds
    turn = 1000 * scene.unit_m * Rotation.from_euler("yx", [40, 30], degrees=True).as_matrix()
    pose = rigid(turn, np.array([2.0, 1.0, 90.0]) - turn @ (low + high) / 2)
    np.save(folder / "scan.npy", scan_of(moved(scene.rest, np.stack([pose, pose])), NOISE))
    model = low + np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) * (high - low)
    picked = transform_points(pose, model) + default_rng(1).normal(scale=1.5, size=(4, 3))  # to 1.5 mm
    start = write(folder, {"object": {"model": model.tolist(), "scan": picked.tolist()}})
    arguments = ["--scene", str(path), "--start", str(start), "--unit", "mm", "--output", str(folder / "truth")]
    assert main(["align", str(folder / "scan.npy"), *arguments]) == 0
    return folder, scene, pose


def test_the_command_places_the_segments_and_the_truth_is_in_one_frame(bar: Bar) -> None:
    """Points are 0.02 mm off and 0.2 mm apart; the bar is 40 mm long."""
    folder, scene, pose = bar
    facts = read_json(folder / "truth/truth.json")
    assert facts["unit"] == "mm" and facts["start"] == "object from start.json"
    assert facts["scan"] == "../scan.npy" and facts["scene"] == "../bar.yaml"
    for segment in scene.rest.segments:
        entry = facts["segments"][segment.name]
        middle = segment.bounds.mean(axis=0)
        shift_mm, turn_deg = pose_error(np.array(entry["T_scan_segment"]), pose, middle)
        assert shift_mm < 0.05 and turn_deg < 0.15
        assert entry["placed_by"] == "scan" and entry["residual"]["median"] < 0.04
    assert {path.name for path in (folder / "truth").glob("[!.]*")} == {"truth.json", "overlay.png", "segments.glb"}
    posed = read_truth(folder / "truth")
    expected = moved(scene.rest, np.stack([pose] * 2))
    for found, true in zip(posed.truth.segments, expected.segments, strict=True):
        assert np.abs(found.vertices - true.vertices).max() < 0.1
    assert (posed.name, posed.frame) == ("truth", "camera")
    assert_array_equal(posed.cloud.points, np.load(folder / "scan.npy"))


@pytest.mark.slow
@pytest.mark.parametrize(("shift_mm", "low", "high"), [(0.0, 1.0, 1.0), (4.0, 0.4, 0.7)])
def test_evaluate_takes_the_truth(bar: Bar, tmp_path: Path, shift_mm: float, low: float, high: float) -> None:
    """Of an answer that is the truth, or the truth moved along x by a tenth of the bar's length."""
    truth = read_truth(bar[0] / "truth").truth
    evaluation = evaluate_weights(
        oracle(truth, (shift_mm, 0.0, 0.0)), tmp_path / "test", EvaluationConfig(scans=[bar[0] / "truth"], cells=20)
    )
    assert list(evaluation.examples) == ["truth"] and low <= evaluation.scores.iou <= high
    written = read_json(tmp_path / "test/metrics.json")
    assert written["iou"] == evaluation.scores.iou and written["scans"] == ["truth"]


@pytest.mark.parametrize(
    "name, content, sentence",
    [
        ("scan.npy", None, "scan.npy, the scan of .*truth.json, does not exist"),
        ("scan.npy", b"else", "scan.npy is not the file that .*truth.json was made from"),
        ("right.stl", "left.stl", "the meshes of the scene '../bar.yaml' are not those"),
        ("truth/truth.json", b'{"format": 2}', "cannot be read as a truth file of mereo align"),
    ],
)
def test_what_no_longer_belongs_together_is_refused(
    bar: Bar, tmp_path: Path, name: str, content: bytes | str | None, sentence: str
) -> None:
    folder = shutil.copytree(bar[0], tmp_path / "moved")
    read_truth(folder / "truth/truth.json")  # a moved folder is still whole
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(content if isinstance(content, bytes) else (folder / content).read_bytes())
    with pytest.raises((ValueError, FileNotFoundError), match=sentence):
        read_truth(folder / "truth/truth.json")


def test_a_truth_file_runs_no_python_that_nobody_has_named(bar: Bar, tmp_path: Path) -> None:
    folder = shutil.copytree(bar[0], tmp_path / "sent")
    (folder / "evil.py").write_text(
        "from pathlib import Path\nfrom dataclasses import replace\nfrom mereo.scenes.registry import load_scene\n"
        "Path(__file__).with_name('was-run').touch()\n"
        "def scene():\n    return replace(load_scene(Path(__file__).with_name('bar.yaml')), name='trusted')\n"
    )
    truth = folder / "truth/truth.json"
    for name in ("../evil.py", "../evil.PY"):
        truth.write_text(json.dumps(read_json(truth) | {"scene": name}))
        with pytest.raises(ValueError, match=f"names the scene '{name}', which is neither built in nor a YAML file"):
            read_truth(truth)
        assert not (folder / "was-run").exists()
    named = load_scene(folder / "evil.py")
    assert read_truth(truth, named).truth.names == ("left", "right") and (folder / "was-run").exists()


def test_a_scene_without_truths_and_two_truths_of_one_name_are_refused(bar: Bar) -> None:
    with pytest.raises(ValueError, match="the scene 'bar' is given without truth files; the bunny's own scans"):
        evaluate(AnalyticModel.of(lambda points: points, ("left", "right")), EvaluationConfig(bar[1], scans=()))
    model = AnalyticModel.of(lambda points: np.zeros((len(points), 3)), ("left", "right"))
    with pytest.raises(ValueError, match="two truths are called 'truth'; results are listed by name"):
        evaluate(model, EvaluationConfig(scans=[bar[0] / "truth", bar[0] / "truth/truth.json"]))


def test_the_command_refuses_another_unit(
    bar: Bar, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(bar[0])
    assert main(["align", "scan.npy", "--scene", "bar.yaml", "--output", "out", "--start", "start.json"]) == 2
    assert "scan units per scene unit, but the units of scene and scan give 0.0005" in capsys.readouterr().err
    assert not (bar[0] / "out").exists()


def test_the_rest_pose_is_exported(bar: Bar, capsys: pytest.CaptureFixture) -> None:
    folder, scene, _ = bar
    for name in ("rest.ply", "rest.glb"):
        assert main(["scene", "export", str(folder / "bar.yaml"), "--output", str(folder / name)]) == 0
        assert_allclose(read_segmented_mesh(folder / name).bounds, scene.rest.bounds, atol=1e-5)
    assert main(["scene", "export", str(folder / "bar.yaml"), "--output", str(folder / "rest.xyz")]) == 2
    assert "has the suffix '.xyz'; it must be .ply or .glb" in capsys.readouterr().err


TOLERANCE = {"body": (0.25, 0.4), "tail": (0.7, 2.0)} | dict.fromkeys(("head", "ear_left", "ear_right"), (0.7, 1.0))
"""Millimetres at the segment's middle, and degrees, from the published pose; the scan lies 0.1 mm from the model."""


def bunny_truth_pose(name: str) -> tuple[SegmentedMesh, ndarray, float]:
    """The bunny at rest, its published pose in a scan, and metres per scene unit."""
    middle, units_per_m = model_to_scene()
    T_model_scene = rigid(np.eye(3) / units_per_m, middle)
    return load_scene("bunny").rest, inv(BUNNY_SCAN_POSES[name]) @ T_model_scene, 1 / units_per_m


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", SCANS)
def test_scans_of_the_bunny_come_to_their_known_pose(name: str, seed: int, require_asset: Require) -> None:
    """From 15 to 20 degrees and a tenth of its size beside it."""
    require_asset("bunny/bunny.off"), require_asset(f"bunny/{name}.ply")
    rest, true, scale = bunny_truth_pose(name)
    size = float(norm(rest.bounds[1] - rest.bounds[0])) * scale
    rough = perturbed(true, rest.bounds.mean(axis=0), 15 + 5 * seed, 0.1 * size, seed)
    placement = place(rest, bunny_scan(name)[0].points, Start(np.stack([rough] * 5), np.zeros(5, bool), ""), "scanner")
    assert placement.explained > 0.99
    for found, segment in zip(placement.segments, rest.segments, strict=True):
        shift, turn_deg = pose_error(found.T_scan_segment, true, segment.bounds.mean(axis=0))
        assert 1000 * shift < TOLERANCE[segment.name][0] and turn_deg < TOLERANCE[segment.name][1], segment.name
        assert not found.seen or 1000 * found.median < 0.15
    unseen = {"bun270": ["tail"], "chin": ["ear_left"]}
    assert [found.name for found in placement.segments if not found.seen] == unseen.get(name, [])


def test_the_bunnys_scans_remain_what_scans_alone_means(require_asset: Require) -> None:
    for name in ("bunny.off", *(f"{scan}.ply" for scan in SCANS)):
        require_asset(f"bunny/{name}")
    posed = bunny_posed("bun000")
    model = AnalyticModel.of(lambda points: np.tile([1.0, 0, 0, 0, 0, 0], (len(points), 1)), posed.truth.names)
    assert list(evaluate(model, EvaluationConfig(scans=(), cells=6)).examples) == list(SCANS)


def test_a_scan_is_put_before_the_camera() -> None:
    """Nearer to the scanner (larger z) becomes nearer to the camera (smaller z); up becomes minus y."""
    scan = default_rng(0).uniform(-1, 1, size=(200, 3)) * [0.3, 0.5, 0.1] + [4.0, 5.0, 6.0]
    T_camera_scanner = into_camera(scan, "scanner")
    seen = transform_points(T_camera_scanner, scan)
    assert_allclose(T_camera_scanner[:3, :3] @ T_camera_scanner[:3, :3].T, np.eye(3))
    assert det(T_camera_scanner[:3, :3]) == pytest.approx(1.0)
    for axis, sign in ((0, 1), (1, -1), (2, -1)):
        assert_array_equal(np.argsort(seen[:, axis]), np.argsort(sign * scan[:, axis]))
    assert_allclose(Normalizer.fit(seen).viewpoint, [0.0, 0.0, -VIEW_DISTANCE], atol=1e-12)
    assert_allclose(transform_points(inverse_rigid(T_camera_scanner), seen), scan)
    with pytest.raises(ValueError, match="there is no scan 'bun045'; it must be one of bun000, bun090, bun270, chin"):
        bunny_scan("bun045")


@pytest.mark.parametrize("name", SCANS)
def test_the_truth_lies_where_the_scan_is(name: str, require_asset: Require) -> None:
    """The pose is right: half of the scan lies within 0.15 mm of the surface, and outside as much as inside."""
    require_asset("bunny/bunny.off"), require_asset(f"bunny/{name}.ply")
    cloud, truth, T_camera_scan = scan_in_camera(name)
    points = cloud.points[::20]
    solids = Solids(truth)
    # cut faces lie inside, so the nearest surface of a scanned point is the bunny's skin
    distance = np.abs(solids.nearest(points).distance)
    assert np.median(distance) < 1.5e-4 and np.quantile(distance, 0.95) < 6e-4
    assert 0.2 < (solids.label(points) > 0).mean() < 0.8
    assert_allclose(
        truth.bounds, bunny_truth(name).transformed(T_camera_scan).bounds, err_msg="scan frame and camera frame agree"
    )
    # the side that the camera sees: scanned points lie nearer than the middle of the object
    assert points[:, 2].min() > 0 and points[:, 2].mean() < truth.bounds.mean(axis=0)[2]
