"""``mereo reconstruct --carry``, and the unit that the input states."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mereo import __main__ as command_line
from mereo.fitting.registration.register import CloudToFit, Registrar, fit_frame
from mereo.io.attachments import read_pose_table
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.volume_files import Volume, read_volume
from mereo.io.writers.volumes import write_volume
from mereo.models.model import Model
from mereo.models.weights import save_model
from mereo.scenes.registry import load_scene
from mereo.synthesis.sample_views import SampleView, load_view

pytestmark = pytest.mark.usefixtures("small_previews")


@pytest.fixture(scope="module")
def weights(rope: Model) -> Model:
    """Those of the rope, whose own files are in centimetres."""
    assert rope.statistical_model is not None
    frame = replace(load_scene("rope"), unit_m=0.01).source_frame
    return replace(rope, statistical_model=replace(rope.statistical_model, source_frame=frame))


@pytest.fixture(scope="module")
def view() -> SampleView:
    return load_view("rope")


@pytest.fixture(scope="module")
def folder(weights: Model, view: SampleView, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, a cloud in centimetres that is said to be so, and four files to carry."""
    folder = tmp_path_factory.mktemp("carry")
    save_model(weights, folder / "rope.safetensors")
    np.save(folder / "cloud.npy", view.depth.to_points().points)
    rest = load_scene("rope").rest
    part = rest.segments[1]
    trimesh.Trimesh(part.vertices, part.faces, process=False).export(folder / "own.ply")
    trimesh.Trimesh(part.vertices, part.faces, process=False).export(folder / "own.glb")
    x, y, z = part.vertices.mean(axis=0)
    volume = Volume(np.arange(8, dtype=np.int16).reshape(2, 2, 2), np.diag([*np.ptp(rest.bounds, axis=0), 1.0]))
    volume.T_world_index[:3, 3] = rest.bounds[0]  # a voxel at each corner of the rest box
    lps = replace(volume, T_world_index=np.diag([-1.0, -1.0, 1.0, 1.0]) @ volume.T_world_index)  # as it is written
    write_volume(folder / "ct.nrrd", lps, 0.001)
    (folder / "grasp.csv").write_text(f"x,y,z,qx,qy,qz,qw,width\n{x},{y},{z},0,0,0,1,0.02\n", encoding="utf-8")
    return folder


def run(folder: Path, *options: str, cloud: str = "cloud.npy", output: str = "out") -> int:
    arguments = ["reconstruct", str(folder / cloud), "--weights", str(folder / "rope.safetensors")]
    return command_line.main([*arguments, "--output", str(folder / output), "--resolution", "32", *options])


def carrying(folder: Path, *names: str) -> list[str]:
    return [word for name in names for word in ("--carry", str(folder / name))]


def test_the_command_carries_in_the_frame_and_unit_of_its_other_files(folder: Path) -> None:
    options = ["--method", "modes", "--unit-m", "0.01", "--millimetres", "--formats", "ply", "glb", "json"]
    assert run(folder, *options, *carrying(folder, "own.ply", "own.glb", "grasp.csv", "ct.nrrd")) == 0
    out = folder / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert [one["file"] for one in summary["carried"]] == ["own.ply", "own.glb", "grasp.csv", "ct.nrrd"]
    assert all(one["farthest"] < 0.01 for one in summary["carried"][:3]) and summary["registration"]["unit"] == "known"
    own = read_segmented_mesh(out / "segments.glb").segments[1].vertices
    carried = read_segmented_mesh(out / "carried/own.glb").segments[0].vertices
    assert np.linalg.norm(carried[: len(own)] - own, axis=1).max() < 0.3
    in_mm = read_segmented_mesh(out / "carried/own.ply").segments[0].vertices
    np.testing.assert_allclose(in_mm, 10 * carried, rtol=1e-4, atol=1e-3)
    grasp = read_pose_table(out / "carried/grasp.csv")
    assert np.linalg.norm(grasp.points[0] / 10 - own.mean(axis=0)) < 1.0
    assert grasp.rows[0][-1] == "0.02" and grasp.rotations is not None
    volume = read_volume(out / "carried/ct.nrrd")  # millimetres: ten of the input's unit
    low, high = (np.diag([-1.0, -1.0, 1.0]) @ bound for bound in read_segmented_mesh(out / "segments.glb").bounds)
    assert (volume.bounds[0] < 10 * np.minimum(low, high)).all() and (
        volume.bounds[1] > 10 * np.maximum(low, high)
    ).all()
    assert list(volume.values.shape) == summary["carried"][3]["voxels"] and volume.values.dtype == np.int16
    together = read_segmented_mesh(out / "carried.glb")
    assert together.names[:2] == ("own.ply", "own.glb") and len(together.names) == 2 + len(summary["segments"])


def test_a_wrong_unit_is_not_believed(weights: Model, view: SampleView) -> None:
    registrar, cloud = Registrar.of(weights, "modes"), view.depth.to_points()
    free = registrar.fit_modes(CloudToFit(cloud.points)).registration()
    metres, true = (registrar.stated_scene_unit(unit_m) for unit_m in (1.0, 0.01))
    # the cloud is said to be in metres
    wrong = registrar.fit_modes(CloudToFit(cloud.points, scene_unit=metres, is_unit_certain=False)).registration()
    right = registrar.fit_modes(CloudToFit(cloud.points, scene_unit=true, is_unit_certain=False)).registration()
    np.testing.assert_array_equal(wrong.material, free.material)
    assert not wrong.unit_known and not free.unit_known
    assert right.unit_known and right.scene_unit == pytest.approx(1.0, rel=1e-4)
    assert weights.statistical_model is not None
    near = fit_frame(
        CloudToFit(cloud.points, scene_unit=0.95, is_unit_certain=False), weights, weights.statistical_model
    )
    assert near.unit == 0.95  # within what the network's own estimate leaves open


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "network"], "--method is network, but --carry needs a registration"),
        (["--carry", "nowhere.stl"], "nowhere.stl does not exist"),
        (["--carry", "."], "has the suffix ''; a file to carry is one of .stl"),
    ],
)
def test_the_command_refuses_before_any_work(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert run(folder, *carrying(folder, "grasp.csv"), *options, cloud="no-such-cloud.npy", output="refused") != 0
    assert message in " ".join(capsys.readouterr().err.split()) and not (folder / "refused").exists()


@pytest.mark.slow
def test_without_a_registration_nothing_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Registrar, "takes", lambda *_: False)  # as of a frame that no state explains
    assert run(folder, *carrying(folder, "grasp.csv"), output="none") != 0
    assert "the network's answer is kept, but --carry needs a registration" in capsys.readouterr().err
    assert not (folder / "none").exists()
