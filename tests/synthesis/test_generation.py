"""Generation: the same bits however the work is shared or interrupted, and never a test seed by accident."""

import json
import os
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from folder_contents import contents, read_json, run_mereo
from numpy.linalg import norm
from numpy.random import Generator
from safetensors.numpy import load_file
from scene_code import CODE
from scene_files import write_bar, write_mesh
from shapes import ball
from toy_data import SMALL
from toy_scene import rest_mesh, sample_deformations, toy_scene

import mereo.__main__ as command_line
from mereo.api.generate import generate
from mereo.cli import training
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.io.atomic_files import JsonObject
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.models.weights import load_model
from mereo.scenes.scene import PAPER_APERTURE_RAD, WHOLE_SPHERE_RAD, Scene, Workspace
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import SENSOR_TERMS, SENSORS, GenerateConfig, SamplingConfig, Sensor, SensorConfig
from mereo.synthesis.examples import Example, View, sample_view, synthesize
from mereo_learning import shards
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.model_card import card
from mereo_learning.scoring import EvaluationConfig
from mereo_learning.shards import example_bytes
from mereo_learning.tables import read_metrics

TOY = toy_scene()


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "SHARD_SIZE", 4)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten examples, made in one go: shards of 4, 4 and 2."""
    output = tmp_path_factory.mktemp("whole") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "SHARD_SIZE", 4)
        generate(TOY, output, SMALL, examples=10, seed=3)
    return output


@pytest.mark.parametrize("calls", [0, 5, 9])
def test_killed_and_resumed_equals_uninterrupted(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    made = 0

    def stops(scene: Scene, settings: GenerateConfig, rng: Generator) -> Example:
        nonlocal made
        if made == calls:
            raise KeyboardInterrupt
        made += 1
        return synthesize(scene, settings, rng)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shards, "synthesize", stops)
        generate(TOY, tmp_path / "data", SMALL, examples=10, seed=3)
    complete = contents(tmp_path / "data")
    assert len(complete) == 3 + calls // 4  # manifest, template and statistical model come first
    assert complete.items() <= contents(whole).items()
    generate(TOY, tmp_path / "data", SMALL, examples=10, seed=3, resume=True)
    assert contents(tmp_path / "data") == contents(whole)


def test_tensors_are_as_documented_and_a_paper_size_dataset_fits_in_2_5_gigabytes(whole: Path) -> None:
    shard = load_file(whole / "shard-00000.safetensors")
    queries = SMALL.sampling.total(4)
    assert {key: (value.dtype.name, value.shape) for key, value in shard.items()} == {
        "cloud": ("float32", (4, 128, 3)),
        "cloud_count": ("int32", (4,)),
        "center": ("float64", (4, 3)),
        "scale": ("float64", (4,)),
        "positions": ("float32", (4, queries, 3)),
        "labels": ("uint8", (4, queries)),
        "distances": ("float32", (4, queries)),
        "directions": ("float16", (4, queries, 3)),
        "rest": ("float16", (4, queries, 3)),
    }
    assert np.array_equal(np.isnan(shard["rest"]).any(axis=-1), shard["labels"] == 0)
    stored = sum(value.nbytes for value in shard.values())
    assert stored == 4 * example_bytes(SMALL, segments=4)
    file = (whole / "shard-00000.safetensors").stat().st_size
    assert file - stored < 2000  # the header, once per 64 examples
    assert 28_800 * example_bytes(GenerateConfig(), segments=5) + 450 * 2000 < 1.65e9 < 2.5e9


def test_manifest_tells_how_to_make_it_again_and_files_have_the_users_permissions(whole: Path) -> None:
    manifest = read_json(whole / "manifest.json")
    assert (manifest["scene"], manifest["seed"], manifest["examples"]) == ("toy", 3, 10)
    assert manifest["settings"]["sampling"]["per_segment"] == 16
    assert [part["name"] for part in manifest["segments"]] == list(TOY.rest.names)
    assert [tuple(part["color"]) for part in manifest["segments"]] == list(TOY.rest.colors)
    assert len(manifest["rest_sha256"]) == 64 and manifest["any_roll"] is False
    assert manifest["bytes"] == 10 * example_bytes(SMALL, 4)
    assert manifest["libraries"]["numpy"] == np.__version__
    mask = os.umask(0)
    os.umask(mask)
    assert all(path.stat().st_mode & 0o777 == 0o666 & ~mask for path in whole.iterdir())


def test_resuming_names_the_setting_that_differs(whole: Path, tmp_path: Path) -> None:
    before = contents(whole)
    sampling = replace(SMALL.sampling, oversample=2)
    cases = [
        (SMALL, 4, 10, "seed = 3, not 4"),
        (SMALL, 3, 11, "examples = 10, not 11"),
        (replace(SMALL, noise_std=0.5), 3, 10, "settings.noise_std = 0.1, not 0.5"),
        (replace(SMALL, sampling=sampling), 3, 10, "settings.sampling.oversample = 1, not 2"),
    ]
    for settings, seed, examples, difference in cases:
        message = rf"was made with {re.escape(difference)}; resuming needs equal settings: use them, or choose another"
        with pytest.raises(ValueError, match=message):
            generate(TOY, whole, settings, examples=examples, seed=seed, resume=True)
    with pytest.raises(ValueError, match="was made with scene = 'toy', not 'rope'"):
        generate("rope", whole, SMALL, examples=10, seed=3, resume=True)
    assert contents(whole) == before


@pytest.mark.parametrize("text", ["{", "[]"])
def test_a_broken_manifest_cannot_be_resumed_nor_a_file_take_a_dataset(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match="holds no settings; what it belongs to cannot be continued: choose"):
        generate(TOY, tmp_path, SMALL, examples=4, seed=1, resume=True)
    with pytest.raises(FileExistsError, match="is a file; a dataset is a directory: choose another output"):
        generate(TOY, tmp_path / "manifest.json", SMALL, examples=4, seed=1)
    assert [path.read_text() for path in tmp_path.iterdir()] == [text]


@pytest.mark.parametrize(
    "options, message",
    [
        ({"examples": 0}, "examples is 0; it must be at least 1"),
        ({"seed": -1}, "seed is -1; it must not be negative"),
        ({"workers": -1}, "the number of workers is -1; it must be at least 1"),
        ({"shard": (2, 2)}, "the shard is 2/2; i/n needs i from 0 to n - 1"),
        ({"seed": TEST_SEED_START}, "seeds from 1000000 up are for testing and never for training"),
        ({"seed": TEST_SEED_START - 1, "test": True}, "a test set needs one from 1000000 up"),
        ({"examples": 10**10}, r"examples=10000000000 needs .* GB and .* GB free: ask for fewer, or change"),
    ],
)
def test_wrong_numbers_are_named_before_anything_is_written(tmp_path: Path, options: JsonObject, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generate(TOY, tmp_path / "data", SMALL, **{"examples": 4, "seed": 1} | options)
    assert not (tmp_path / "data").exists()


def made(scene: Path, output: Path, workers: int = 1, examples: int = 2, resume: bool = False) -> dict[str, bytes]:
    generate(str(scene), output, SMALL, examples=examples, seed=0, workers=workers, resume=resume)
    return contents(output)


def test_an_edited_scene_is_not_resumed_but_an_edited_comment_is(tmp_path: Path) -> None:
    scene = write_bar(tmp_path, "deformations:\n  - type: lattice\n    strength: 0.5\n")
    first = made(scene, tmp_path / "data")
    manifest = json.loads(first["manifest.json"])
    assert manifest["scene"] == "bar" and len(manifest["scene_file_sha256"]) == 64
    assert manifest["unit_m"] == pytest.approx(0.0005)
    scene.write_text("# a comment\n" + scene.read_text())
    assert made(scene, tmp_path / "data", resume=True) == first
    scene.write_text(scene.read_text().replace("0.5", "0.4"))
    # the deformation decides how long faces are divided, so the rest mesh is another one, too, and is compared first
    with pytest.raises(ValueError, match="was made with (rest|scene_file)_sha256 = .*resuming needs equal settings"):
        made(scene, tmp_path / "data", resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["yaml", "py"])
def test_two_workers_make_the_same_files_as_one(kind: str, tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    if kind == "py":
        scene = tmp_path / "mine.py"
        file = write_mesh(ball((0, 0, 0), 10.0, level=2), tmp_path / "ball.ply")
        scene.write_text(CODE.format(name="mine", file=str(file)))
    one = made(scene, tmp_path / "one", 1, examples=70)
    assert made(scene, tmp_path / "two", 2, examples=70) == one


NARROW = Workspace(axis=(0.0, 1.0, 0.0), aperture_rad=0.5)
ALL_AROUND = Workspace(axis=(1.0, 0.0, 0.0), aperture_rad=WHOLE_SPHERE_RAD, any_roll=True, distance=(90.0, 95.0))


def generate_options(text: str) -> GenerateConfig:
    command = command_line.parse(f"generate rope --examples 7 --output out {text}".split())
    assert isinstance(command, training.Generate)
    return command.settings


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("form", ["--sensor {}", "--sensor={}"])
def test_an_option_chooses_a_sensor(name: Sensor, form: str) -> None:
    assert generate_options(form.format(name)) == GenerateConfig(sensor=SENSORS[name])
    command = command_line.parse(f"evaluate rope --output out {form.format(name)}".split())
    assert isinstance(command, training.Evaluate) and command.terms == SENSORS[name]
    assert SENSORS[name].on == (name != "paper")


def test_terms_are_added_to_a_sensor_and_all_are_off_by_default() -> None:
    chosen = generate_options("--sensor structured-light --sensor.tool 0.3 --sensor.holes 0 --sampler label-uniform")
    assert chosen.sensor == replace(SENSORS["structured-light"], tool=0.3, holes=0.0)
    assert chosen.sampling.sampler == "label-uniform"
    assert generate_options("--sensor.axial 1").sensor == SensorConfig(axial=1.0)
    lengths = {"metres_per_unit", "model", "hole_radius_m"}
    assert set(SENSOR_TERMS) | lengths == set(SensorConfig.__dataclass_fields__)
    assert not SensorConfig().on and set(get_args(Sensor)) == set(SENSORS)
    assert all(replace(SensorConfig(), **{name: 0.1}).on for name in SENSOR_TERMS)


@pytest.mark.parametrize(
    "options, sentence",
    [
        ("generate rope --examples 7 --sensor lidar", "invalid choice 'lidar'.*'time-of-flight'"),
        ("evaluate rope --workspace dome", "invalid choice 'dome' for argument '--workspace'"),
        ("generate rope --examples 1 --sensor.flying 2", "error: sensor.flying is 2.0; it must be from 0 to 1: give"),
        ("evaluate bunny --scans --sensor time-of-flight", "are real and take no simulated camera: leave out --sen"),
        ("evaluate bunny --scans --workspace cone", "--noise-std and --workspace"),
    ],
)
def test_unknown_and_contradictory_options_are_refused_before_anything_is_written(
    options: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    try:
        code = run_mereo(*options.split(), "--output", tmp_path / "out")
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr().err
    assert code == 2 and re.search(sentence, printed, re.DOTALL), printed
    assert not list(tmp_path.iterdir())


def test_a_scene_has_its_own_workspace_a_cone_and_the_sphere() -> None:
    scene = replace(TOY, workspace=NARROW)
    assert scene.workspace_named("own") is scene.workspace_named("cone") is NARROW
    assert scene.workspace_named("sphere") is not NARROW
    assert asdict(scene.workspace_named("sphere")) == asdict(NARROW) | {"aperture_rad": 2 * np.pi, "any_roll": True}
    scene = replace(TOY, workspace=ALL_AROUND)
    assert scene.workspace_named("own") is scene.workspace_named("sphere") is ALL_AROUND
    expected = asdict(ALL_AROUND) | {"aperture_rad": PAPER_APERTURE_RAD, "any_roll": False}
    assert asdict(scene.workspace_named("cone")) == expected
    assert replace(scene, cone=NARROW).workspace_named("cone") is NARROW


def test_evaluation_looks_through_the_sensor_from_the_workspace_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = []
    encode = Model.encode

    def watch(model: Model, cloud: PointCloud) -> EncodedCloud:
        clouds.append(cloud)
        return encode(model, cloud)

    monkeypatch.setattr(Model, "encode", watch)
    spoilt = GenerateConfig(128, 0.5, sensor=SENSORS["structured-light"])
    found = []
    for number, settings in enumerate((GenerateConfig(), spoilt, GenerateConfig(workspace="sphere"))):
        config = EvaluationConfig(examples=1, cells=12, settings=settings, method="network")
        evaluate_weights("rope", tmp_path / str(number), config)
        found.append(read_metrics(tmp_path / str(number) / "metrics.json"))
    own, through, around = found
    assert [(fact["image_size"], fact["noise_std"]) for fact in found] == [(96, 0.1), (128, 0.5), (96, 0.1)]
    assert [SensorConfig(**fact["sensor"]) for fact in (own, through)] == [SENSORS["paper"], spoilt.sensor]
    assert len(clouds) == 3 and not np.array_equal(clouds[0].points[:20], clouds[1].points[:20])
    assert (own["workspace"], around["workspace"]) == ("own", "sphere") and own["iou"] != around["iou"]
    assert ", workspace sphere, noise 0.1 units" in card("rope", load_model("rope"), [around], b"")
    assert "workspace sphere" not in card("rope", load_model("rope"), [own], b"").split("## Results")[-1]


SETTINGS = GenerateConfig(sampling=SamplingConfig(per_segment=128))
Case = tuple[Example, View]


@pytest.fixture(scope="module", params=range(3))
def case(request: pytest.FixtureRequest) -> Case:
    """An example and the view it was made from: the view is drawn first, from the same generator."""
    example, view = (make(TOY, SETTINGS, example_rng(1, request.param)) for make in (synthesize, sample_view))
    return example, view  # type: ignore[return-value]


def test_the_cloud_is_the_depth_image_unprojected_and_normalized(case: Case) -> None:
    example, view = case
    seen = view.depth.to_points().points
    kept = example.normalizer.invert(example.cloud)
    gaps = norm(kept[:, None] - seen[None], axis=-1)
    assert gaps.min(axis=1).max() < 1e-6
    assert len(np.unique(gaps.argmin(axis=1))) == len(kept) == min(len(seen), SETTINGS.points)
    box = example.normalizer.apply(seen)
    low = box.min(axis=0)
    high = box.max(axis=0)
    assert np.isclose((high - low).max(), 2) and np.allclose(low + high, 0)
    distance = Solids(view.mesh).nearest(seen).distance
    # noise is along the ray: never farther from the surface than that, 0.1 in standard deviation
    assert distance.max() < 0.6 and 0.02 < distance.mean() < 0.1


def test_labels_distances_and_directions_are_those_of_the_deformed_segments(case: Case) -> None:
    example, view = case
    queries = example.queries
    solids = Solids(view.mesh)
    points = example.normalizer.invert(queries.positions)
    clear = solids.nearest(points).distance > 1e-6
    assert np.array_equal(solids.label(points[clear]), queries.labels[clear])
    assert np.array_equal(queries.distances < 0, queries.labels > 0)
    assert len(queries.labels) == SETTINGS.sampling.total(4)
    foot = queries.positions + np.abs(queries.distances)[:, None] * queries.directions
    assert solids.nearest(example.normalizer.invert(foot)).distance.max() < 1e-6
    assert np.allclose(norm(queries.directions, axis=1), 1)


def test_rest_coordinates_lead_back_to_the_query_and_lie_in_the_same_segment_at_rest(case: Case) -> None:
    """The theorem: deform(rest) is the query's place in the scene; outside there is no rest."""
    example, view = case
    queries = example.queries
    low, high = TOY.rest.bounds
    rest = queries.rest * (high - low).max() / 2 + (low + high) / 2
    world = transform_points(view.T_world_camera, example.normalizer.invert(queries.positions))
    assert np.array_equal(np.isnan(queries.rest).any(axis=1), queries.labels == 0)
    for index, deformation in enumerate(view.deformations):
        members = queries.labels == index + 1
        assert members.sum() >= 64
        assert np.abs(deformation(rest[members]) - world[members]).max() < 1e-3
        assert (np.abs(queries.rest[members]) <= 1 + 1e-4).all()
    inside = queries.labels > 0
    solids = Solids(TOY.rest)
    rest = rest[inside]
    # faces are flat before and after, the map between them is not: only points beside a face may change sides
    clear = solids.nearest(rest).distance > 0.1
    assert np.array_equal(solids.label(rest[clear]), queries.labels[inside][clear])


def test_views_that_see_too_little_are_drawn_again_and_a_scene_out_of_sight_is_named() -> None:
    far = toy_scene(distance=(20_000.0, 20_001.0))
    with pytest.raises(ValueError, match=rf"'toy' showed fewer than {MIN_POINTS} points in 100 random views"):
        sample_view(far, SETTINGS, example_rng(0, 0))

    def sometimes_tiny(rng: Generator) -> tuple:
        tiny = bool(rng.random() < 0.5)
        return tuple((lambda p, d=d: 1e-3 * p) if tiny else d for d in sample_deformations(rng))

    scene = Scene("blinking", SegmentedMesh(rest_mesh().segments), sometimes_tiny, Workspace())
    counts = [sample_view(scene, SETTINGS, example_rng(4, index)).depth.valid.sum() for index in range(12)]
    assert min(counts) >= MIN_POINTS
