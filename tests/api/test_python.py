"""mereo in Python: frames, results that are saved, shown and told, and the commands as functions."""

import base64
import inspect
import io
import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from analytic import untrained
from angle import write_angle
from answers import answer_to
from folder_contents import read_json
from numpy.linalg import det, inv, norm
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from toy_frames import MODEL, NAMES, seen
from toy_scene import toy_scene
from two_balls import BIG, SMALL

import mereo
from mereo.__main__ import main
from mereo.api import reconstruct, steps, view
from mereo.api.result import SINGLE, Result
from mereo.api.words import SPEAKS_OPTIONS, in_python, option_words, python_words
from mereo.cli.answers import ReconstructCommand
from mereo.cli.options import flat_options, options_of
from mereo.cli.reconstruct import FrameJob, reconstruct_file
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Located
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes, Way
from mereo.geometry.transforms import transform_points
from mereo.io.atomic_files import MARKER, JsonObject
from mereo.io.config import InputConfig, MeshesConfig
from mereo.io.sensor_frame import SensorFrame
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, SizeWarning, find_object
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SourceFrame
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.sample_views import load_view
from mereo.visualization.units import Unit
from mereo_learning import shards
from mereo_learning.cases import Evaluation
from mereo_learning.config import PRESETS
from mereo_learning.learn import LearnConfig
from mereo_viewer import result_page
from mereo_viewer.server import OpenPage

pytestmark = pytest.mark.usefixtures("small_previews")


@pytest.fixture(scope="module")
def result() -> Result:
    return mereo.reconstruct(seen(), MODEL, resolution=24, unit_m=1.0, label_points=True)


def contents(folder: Path) -> JsonObject:
    """Files of a folder by name; of figures what does not differ from run to run."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.name == "summary.json":
            facts = read_json(path)
            found[path.name] = {name: value for name, value in facts.items() if name not in ("timings_s", "weights")}
        elif path.name == "report.html":
            found[path.name] = re.sub(r'"timings_s": \{.*?\}|"weights": ".*?"', "", path.read_text())
        elif path.name not in (MARKER, "config.json"):
            found[path.name] = path.read_bytes()
    return found


@pytest.mark.parametrize("unit_m", [None, 0.5])
def test_a_result_is_saved_as_the_command_does(
    unit_m: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "cloud.npy", seen())
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: MODEL)
    command = ReconstructCommand((), weights="any", resolution=24, reading=InputConfig(unit_m=unit_m))
    reconstruct_file(tmp_path / "cloud.npy", tmp_path / "command", FrameJob(command))
    found = mereo.reconstruct(tmp_path / "cloud.npy", MODEL, resolution=24, unit_m=unit_m)
    assert found.save(tmp_path / "python") == tmp_path / "python"
    ours, theirs = contents(tmp_path / "python"), contents(tmp_path / "command")
    assert ours == theirs and len(ours) == 5 and (tmp_path / "python" / MARKER).is_file()
    assert ours["summary.json"]["unit_m"] == unit_m and found.unit_m == unit_m


def test_one_file_is_that_of_the_folder(result: Result, tmp_path: Path) -> None:
    result.save(tmp_path / "all", formats=("glb", "ply", "npz", "vti", "seg.nrrd", "json"))
    folder = contents(tmp_path / "all")
    for suffix in SINGLE:
        if suffix == ".nii.gz":  # needs an extra, and compresses the time with it
            continue
        path = result.save(tmp_path / f"one{suffix}")
        name = next(name for name in folder if name.endswith(suffix))
        (tmp_path / suffix).mkdir()
        path.rename(tmp_path / suffix / name)
        assert contents(tmp_path / suffix) == {name: folder[name]}, suffix
    assert result.save(tmp_path / "take-1.2", formats=("npz",)).is_dir()


def test_nobodys_files_are_replaced(result: Result, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("keep")
    for place in ("out", "one.glb"):
        (tmp_path / "one.glb").write_text("keep")
        with pytest.raises(FileExistsError, match="not overwritten: .* overwrite=True$"):
            result.save(tmp_path / place)
    with pytest.raises(FileExistsError, match="not written by this version of mereo"):
        result.save(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out/mine.txt").read_text() == (tmp_path / "one.glb").read_text() == "keep"
    result.save(tmp_path / "one.glb", overwrite=True)
    assert (tmp_path / "one.glb").read_bytes()[:4] == b"glTF"
    np.savez(tmp_path / "frame.npz", points=seen())
    with pytest.raises(FileExistsError, match="frame.npz"):
        mereo.reconstruct(tmp_path / "frame.npz", MODEL, resolution=8).save(tmp_path / "frame.npz", overwrite=True)


def test_values_tell_themselves_in_one_line(result: Result) -> None:
    rope = load_scene("rope")
    camera = Camera.from_fov(4, 3, 0.5)
    found = result.reconstruction
    parts = [found.surfaces, found.surfaces.segments[0], found.labels, found.segments, found.code, found.reading]
    empty = [PointCloud(np.zeros((0, 3))), DepthImage(np.zeros((3, 4)), camera)]
    frames = [result.seen, result.seen.frame, result.seen.cloud, *empty]
    image = DepthImage(np.full((3, 4), 2.0), camera)
    evaluation = Evaluation(("a",), np.array([[5, 1], [1, 3]]), {})
    located = Located(np.ones(1, np.uint8), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))
    asked = MODEL.query(found.code, seen()[:5])
    known = [untrained(("a",)), rope, toy_scene(), image, asked, located, evaluation]
    for value in (result, found, found.observed, *parts, *frames, *known):
        assert "\n" not in repr(value) and "array(" not in repr(value) and len(repr(value)) < 250, repr(value)
    assert repr(result.seen.cloud) == "PointCloud(1,200 points, 0.12 x 0.18 x 0.06)"
    assert repr(image) == "DepthImage(4 x 3 pixels, 12 measured, depth 2 to 2)"
    assert repr(result).startswith("Result('cloud': 2 of 3 segments; network alone; ")
    assert repr(evaluation) == "Evaluation(0 examples: IoU 0.600, mIoU 0.600; a)"
    assert "9 segments: base, segment_1, segment_2, segment_3, segment_4, ... (9)" in repr(rope)


def test_a_notebook_shows_pictures_and_figures(result: Result) -> None:
    page = result._repr_html_()
    contents = (io.BytesIO(base64.b64decode(code)) for code in re.findall(r'base64,([^"]+)"', page))
    pictures = [np.asarray(Image.open(content).convert("RGB")) for content in contents]
    assert [picture.shape[1] for picture in pictures] == [300, 300] and len(page) < 60_000
    dots = [int((picture.max(axis=2) < 60).sum()) for picture in pictures]
    assert dots[0] > 1.5 * dots[1] > 0, "the camera sees all that it has measured, its right half of it"
    rows = re.findall(r"<tr>(.*?)</tr>", page)[1:]
    assert ["&lt;small&gt;" in row for row in rows] == [False, True, False] and "<small>" not in page
    assert "<td>\N{EN DASH}</td><td>0</td>" in rows[2] and "volume (cm³)" in page and "centre x, y, z (mm)" in page
    place, volume, _ = re.findall(r"<td>(.*?)</td>", rows[0])
    assert float(volume) == pytest.approx(4 / 3 * np.pi * 6**3, rel=0.02)
    assert_allclose([float(value) for value in place.split()], [20, -30, 600], atol=2)


def test_a_size_of_none_is_warned_of_at_the_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "cloud.npy", seen())
    known = replace(MODEL, provenance={"visible_m": [2, 3]})
    monkeypatch.setattr(reconstruct, "reconstruct_observation", inspect.unwrap(reconstruct.reconstruct_observation))
    for one in (tmp_path / "cloud.npy", [seen()]):
        with pytest.warns(SizeWarning, match="the visible part is 0.18 m long, but 2 to 3 m in training") as warned:
            inspect.unwrap(mereo.reconstruct)(one, known, resolution=8, unit_m=1.0)
        assert warned[0].filename == __file__ and "--" not in str(warned[0].message)
        mereo.reconstruct(one, known, resolution=8)  # of no stated unit, so that there is nothing to warn of


def test_fields_of_isolation_are_arguments_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = list[tuple[IsolationConfig, Observation]]()

    def isolate(frame: SensorFrame, isolation: IsolationConfig) -> Observation:
        taken.append((isolation, find_object(frame, isolation)))
        return taken[-1][1]

    monkeypatch.setattr(reconstruct, "find_object", isolate)
    mereo.reconstruct(seen(), MODEL, resolution=8, extent="partial", unit_m=1.0)
    isolation, observed = taken.pop()
    assert isolation == IsolationConfig(extent="partial") and observed.extent == "partial"
    assert observed.frame.unit_m == 1.0, "the arguments of load_frame are those of the frame"
    mereo.reconstruct(seen(), MODEL, resolution=8, isolation=IsolationConfig(extent="whole"), keep_all=True)
    assert taken.pop()[0] == IsolationConfig(extent="whole", keep_all=True)
    with pytest.raises(ValueError, match="isolation is given for an object that is isolated already"):
        mereo.reconstruct(observed, MODEL, extent="whole")
    assert {item.name for item in fields(IsolationConfig)}.isdisjoint(item.name for item in fields(InputConfig))
    stated = dict(flat_options(options_of(ReconstructCommand(()), "reconstruct"))).keys()
    assert stated - reconstruct.RECONSTRUCT_OPTIONS - reconstruct.PLACES.keys() == {"command", "inputs", "object"}


def test_a_tracker_begins_at_a_pose_and_leaves_out_what_it_is_told() -> None:
    cloud = load_view("liver").depth.to_points().points
    liver = load_model("liver")
    pose = Result.of(answer_to(cloud, liver, Registrar.of(liver, "modes"), 16, unit_m=UNIT_M)).pose
    known = mereo.Object(None, None, model=liver.statistical_model)
    low, high = UNIT_M * (cloud.min(axis=0) - 1), UNIT_M * (cloud.max(axis=0) + 1)
    around = IsolationConfig(box=(*low.tolist(), *high.tolist()))
    beyond = np.concatenate([cloud, cloud[:50] + np.array([0, 0, 1000.0])])
    with mereo.Tracker(known, "modes", initial_pose=pose, isolation=around) as tracker:
        first, second = (tracker.follow(beyond, 0.03 * step, unit_m=UNIT_M) for step in range(2))
        assert (first.located_by, first.tracked, second.tracked) == ("pose", False, True)
        assert len(first.seen.cloud) <= len(cloud) and first.seen.steps[0].name == "box"
        third = tracker.follow(cloud, 0.09, isolation=IsolationConfig(), unit_m=UNIT_M, extent="partial")
        assert third.seen.extent == "partial" and "box" not in [step.name for step in third.seen.steps]


@pytest.mark.parametrize("way", ["rigid", "soft", "stiff", "articulated"])
def test_meshes_deform_as_their_user_says(way: Way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the file that ``mereo scene new --deformations`` writes."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    files = write_angle(tmp_path)
    scene = load_scene(write_scene_file(files, tmp_path / "angle.yaml", units="mm", deformations=way))
    known = mereo.load_object(files, units="mm", deformations=way)
    assert known.scene is not None
    ours, theirs = (each.sample_state(example_rng(0, 7)).mesh.merged()[0] for each in (known.scene, scene))
    assert_array_equal(ours, theirs)
    moved = np.abs(ours - known.scene.rest.merged()[0]).max()
    assert moved == 0 if way == "rigid" else moved > 0
    command = ReconstructCommand((), object=tuple(map(str, files)), meshes=MeshesConfig("mm", way))
    loaded = FrameJob(command).object.scene
    assert loaded is not None
    assert_array_equal(loaded.sample_state(example_rng(0, 7)).mesh.merged()[0], theirs)


def test_a_part_alone_has_no_joints(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="to be articulated, and no parts of it touch as in a joint: take soft, "):
        mereo.load_object(write_angle(tmp_path)[0], units="mm", deformations="articulated")


def test_a_page_stays_open_where_somebody_goes_on(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = OpenPage(server := MagicMock(**{"get_port.return_value": 1234}))
    monkeypatch.setattr("mereo_viewer.server.threading", MagicMock())
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    assert page.stay() is page and not server.stop.called
    assert capsys.readouterr().out == "open http://127.0.0.1:1234 in a browser; close() ends\n"
    assert 'iframe src="http://127.0.0.1:1234"' in page._repr_html_()
    assert repr(page) == "OpenPage('http://127.0.0.1:1234')"
    monkeypatch.delattr(sys, "ps1")
    page.stay()
    page.close()
    assert server.stop.call_count == 1 and "Ctrl-C ends" in capsys.readouterr().out
    assert "iframe" not in page._repr_html_()


def test_a_result_is_viewed_as_it_is(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (result_page, view):
        monkeypatch.setattr(module, "import_viser", lambda: None)
    start, show = MagicMock(**{"return_value.get_port.return_value": 1234}), MagicMock()
    monkeypatch.setattr(result_page, "start_server", start)
    monkeypatch.setattr(result_page, "ResultPage", show)
    with result.show(block=False) as page, mereo.view(result, block=False, port=8081):
        assert page.address == "http://127.0.0.1:1234"
    assert [given.args for given in start.call_args_list] == [(0,), (8081,)]
    content = show.call_args[0][1]
    assert content.mesh is result.reconstruction.surfaces
    assert (content.title, content.unit, content.depth) == ("cloud", Unit(1.0), None)
    assert content.facts.startswith("1,200 points")
    with pytest.raises(ValueError, match="frame.ply is given without its object: name the object's meshes"):
        mereo.view("frame.ply", block=False)


UNIT_M, SCALE = 0.01, 4.0
"""Metres per scene unit of the sized rope, and scene units per unit of its files."""


def test_segments_are_had_by_their_names(result: Result) -> None:
    assert result.names == NAMES and len(result) == 3
    for name, (center, radius) in zip(NAMES, (BIG, SMALL), strict=False):
        found = result[name]
        assert_allclose(found.centroid, center, atol=0.003)
        assert found.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.05)
        assert found.name == name and found.label == NAMES.index(name) + 1 and found.is_present
        assert 0.5 < found.confidence <= 1 and found.error_radius is None and found.pose is None
        assert found.mesh is result.surfaces.segments[found.label - 1]
    assert result["big"] is result["big"]


def test_an_absent_segment_is_there_and_says_so(result: Result) -> None:
    absent = result["absent"]
    assert not absent.is_present and absent.volume == 0 and np.isnan(absent.confidence) and len(absent.mesh.faces) == 0
    with pytest.raises(KeyError, match="there is no segment 'bigg'; the segments are big, <small>, absent"):
        result["bigg"]
    assert repr(absent) == "SegmentResult('absent', not found)" and "volume" in repr(result["big"])


@pytest.fixture(scope="module")
def registrar(rope: Model) -> Registrar:
    """That of a rope of a known true size, whose files are in another frame and unit than its scene."""
    T_scene_source = np.array([[0.0, -SCALE, 0, 1], [SCALE, 0, 0, 2], [0, 0, SCALE, 3], [0, 0, 0, 1]])
    assert rope.statistical_model is not None
    own = replace(rope.statistical_model, source_frame=SourceFrame(T_scene_source, UNIT_M))
    return Registrar(rope, own, "modes")


def rest_in_files(model: StatisticalModel) -> np.ndarray:
    """Points at rest in the frame and unit of the object's files."""
    source = model.source_frame
    assert source is not None
    return transform_points(inv(source.T_scene_source), model.rest_points)


@pytest.mark.parametrize("unit, axes", [(UNIT_M, "camera"), (0.001, "scanner")])
def test_the_pose_brings_the_objects_files_to_the_frame(
    unit: float, axes: CloudAxes, rope: Model, registrar: Registrar
) -> None:
    points = load_view("rope").depth.to_points().points * (UNIT_M / unit)
    points = points if axes == "camera" else points @ SCANNER_TO_CAMERA[:3, :3]
    answer = answer_to(points, rope, registrar, 16, axes, unit)
    result = Result.of(answer)
    registered = result.registered
    assert registered is not None and result.pose is not None and result.unit_m == unit
    assert result.model_scale == pytest.approx(SCALE * UNIT_M / unit, rel=0.1)
    assert_allclose(result.pose[:3, :3] @ result.pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert det(result.pose[:3, :3]) == pytest.approx(1.0)
    rest = rest_in_files(registered.model)
    placed = transform_points(result.pose, result.model_scale * rest)
    away = norm(placed - registered.material, axis=1)
    length = float(np.ptp(registered.material, axis=0).max())
    assert np.median(away) < 0.5 * length, "rigidly placed, a bent rope lies about where it is"
    assert_allclose(placed.mean(axis=0), registered.material.mean(axis=0), atol=1e-6 * length)


def test_each_segment_has_its_own_pose_and_radius(rope: Model, registrar: Registrar) -> None:
    result = Result.of(answer_to(load_view("rope").depth.to_points(), rope, registrar, 16, unit_m=UNIT_M))
    registered, whole = result.registered, result.pose
    assert registered is not None and whole is not None and result.model_scale is not None
    rest = rest_in_files(registered.model)
    for one in result:
        rows = registered.model.labels == one.label
        assert one.pose is not None and one.error_radius is not None and one.error_radius > 0
        own, common = (
            norm(transform_points(T, result.model_scale * rest[rows]) - registered.material[rows], axis=1)
            for T in (one.pose, whole)
        )
        assert np.sqrt((own**2).mean()) < np.sqrt((common**2).mean()), one.name


def test_a_unit_that_nobody_states_is_found_by_the_true_size(rope: Model, registrar: Registrar) -> None:
    cloud = load_view("rope").depth.to_points()
    result = Result.of(answer_to(cloud, rope, registrar, 16))
    assert result.unit_m == pytest.approx(UNIT_M, rel=0.05) and result.seen.facts()["unit_m"] == result.unit_m
    unsized = Registrar(rope, replace(registrar.model, source_frame=None), "modes")
    free = Result.of(answer_to(cloud, rope, unsized, 16))
    assert free.unit_m is None and free.pose is not None
    assert free.registered is not None and free.model_scale == free.registered.scene_unit


def test_without_a_name_it_is_saved_beside_the_last(result: Result, working_folder: Path) -> None:
    assert [result.save(formats=("json",)) for _ in range(3)] == [Path("result"), Path("result2"), Path("result3")]
    assert {path.name for path in working_folder.iterdir()} == {"result", "result2", "result3"}
    (working_folder / "result2").rename(working_folder / "other")
    (working_folder / "result2").symlink_to(working_folder / "nowhere")
    assert result.save(formats=("json",)) == Path("result4"), "a link that leads nowhere is somebody's"


def test_generate_and_train_are_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(shards, "generate", lambda *given, **named: calls.append((*given, named)))
    assert mereo.generate(tmp_path / "mine.yaml", str(tmp_path / "data"), examples=3, workers=2) == tmp_path / "data"
    ((scene, output, config, named),) = calls
    assert (scene, output) == (str(tmp_path / "mine.yaml"), tmp_path / "data")
    assert config == shards.DatasetConfig(GenerateConfig(), 3, 0)
    assert named == {"workers": 2, "shard": (0, 1), "resume": False}
    trained = []
    monkeypatch.setattr(steps.trainer, "train", lambda data, run, recipe, device: trained.append(recipe) or run / "w")
    assert mereo.train("data", tmp_path, "tiny", init="rope") == tmp_path / "w"
    assert trained == [replace(PRESETS["tiny"], init="rope")]


def test_evaluate_scores_with_and_without_a_folder(tmp_path: Path) -> None:
    model = untrained(load_scene("rope").rest.names)
    alone = mereo.evaluate(model, examples=1, cells=8, method="network", progress=False)
    written = mereo.evaluate(
        model, scene=load_scene("rope"), output=tmp_path / "out", examples=1, cells=8, method="network"
    )
    assert_array_equal(alone.confusion, written.confusion)
    assert len(alone.seconds) == 1
    assert read_json(tmp_path / "out/metrics.json")["scene"] == "rope"
    with pytest.raises(ValueError, match="scans are real and take no simulated camera"):
        mereo.evaluate(model, scans=(), settings=GenerateConfig(image_size=48))


def test_learn_and_export_return_what_they_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    scores = {"iou": 0.9, "miou": 0.8, "trained": True, "method": "auto"}
    monkeypatch.setattr(steps.learning, "learn", lambda files, output, config: calls.append((files, config)) or scores)
    learned = mereo.learn("rope", tmp_path, minutes=3)
    assert calls == [([Path("rope")], LearnConfig(minutes=3))]
    assert learned.weights == tmp_path / "weights.safetensors" and learned.scene == "rope" and learned.miou == 0.8
    assert repr(learned) == f"Learned({str(tmp_path)!r}: trained, method auto, IoU 0.900, mIoU 0.800)"
    scores |= {"trained": False, "method": "search"}
    learned = mereo.learn("rope", tmp_path, train="never")
    assert learned.weights is learned.report is None and learned.method == "search" and learned.folder == tmp_path
    monkeypatch.setattr(steps, "export_weights", lambda *given: calls.append(given))
    assert mereo.export("rope", tmp_path / "graphs", "torch") == tmp_path / "graphs"
    assert calls[-1] == ("rope", tmp_path / "graphs", "torch", False)


# --- sentences name options on the command line and arguments in Python -----------------------------------------------


OUT = "choose another --output or pass --force"


@pytest.mark.parametrize(
    ("option", "argument"),
    [
        (OUT, "choose another output or pass overwrite=True"),
        ("(--keep-all keeps them)", "(keep_all=True keeps them)"),
        ("state that a part is seen (--extent partial)", 'state that a part is seen (extent="partial")'),
        ("for example --depth-range 0.4 0.9", "for example depth_range=(0.4, 0.9)"),
        ("widen --depth-range, or crop with --box", "widen depth_range, or crop with box"),
        ("--largest-cluster --cluster-gap 0.01", "largest_cluster=True cluster_gap=0.01"),
        (
            "the unit (--unit-m 0.001 for millimetres, --depth-scale)",
            "the unit (unit_m=0.001 for millimetres, depth_scale)",
        ),
        ("turn the cloud (--frame), or give --frame-index 0", "turn the cloud (axes), or give frame_index=0"),
        ("needed: give --intrinsics FILE", "needed: give intrinsics=file"),
        ("ask again with --method network.", 'ask again with method="network".'),
        ("two - or three -- of them, well-known", "two - or three -- of them, well-known"),
    ],
)
def test_options_are_arguments_in_python(option: str, argument: str) -> None:
    assert in_python(option) == argument
    assert in_python(argument) == argument, "said once"


def test_an_error_is_told_in_the_words_of_who_asks() -> None:
    with pytest.raises(FileExistsError) as caught, python_words():
        raise FileExistsError(OUT)
    assert str(caught.value) == in_python(OUT)
    with option_words(), pytest.raises(FileExistsError) as caught, python_words():
        raise FileExistsError(OUT)
    assert str(caught.value) == OUT and not SPEAKS_OPTIONS.get()
    with pytest.raises(KeyError, match="--force"), python_words():
        raise KeyError("--force")
    with pytest.raises(OSError) as system, python_words():
        raise OSError(2, "--force")
    assert system.value.errno == 2 and system.value.strerror == "--force"


def test_one_frame_is_refused_in_two_languages(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The command's words are options, also after somebody has asked in Python."""
    cloud = seen()
    cloud[3] = np.nan
    np.save(tmp_path / "cloud.npy", cloud)
    for ask in (mereo.load_frame, lambda path: mereo.reconstruct(path, MODEL)):
        with pytest.raises(ValueError, match="drop_invalid=True$"):
            ask(tmp_path / "cloud.npy")
        arguments = ["reconstruct", str(tmp_path / "cloud.npy"), "--weights", "rope", "--output", str(tmp_path / "out")]
        assert main(arguments) == 2 and "--drop-invalid" in capsys.readouterr().err
        assert not SPEAKS_OPTIONS.get()
