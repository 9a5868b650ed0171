"""Frame of an object's own files: it takes what is defined beside them to the scene, from the model alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from scene_files import write_bar

from mereo.fitting.registration.carry import place
from mereo.fitting.registration.register import Registrar
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.io.attachments import Attachment, Positions
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.models.weights import load_model, save_model
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import pack_model, unpack_model


def test_files_in_millimetres_come_to_the_scene(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path))
    for name, part in zip(("left", "right"), scene.rest.segments, strict=True):
        own = read_segmented_mesh(tmp_path / f"{name}.stl").segments[0].vertices
        # long faces are divided, which adds vertices after the file's own
        np.testing.assert_allclose(transform_points(scene.T_scene_source, own), part.vertices[: len(own)], atol=1e-9)
    assert scene.source_frame.scale == pytest.approx(2.0)  # 10 mm become 20 units
    assert scene.source_frame.unit_m * scene.source_frame.scale == pytest.approx(0.001)
    model = scene_model(scene, 20)
    assert model.source_frame is not None and model.source_frame.unit_m == scene.unit_m
    registrar = Registrar(untrained(scene.rest.names, "bar"), model)
    middle = Positions(np.array([[120.0, 5.0, 5.0]]))
    (found,) = place([Attachment("middle", middle)], registrar)
    np.testing.assert_allclose(found.content.points, [[0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "file"),
    [
        ("bunny", "bunny/bunny.off"),
        ("liver", "liver/lapgym_liver_visual.stl"),
        ("tumor", "liver/lapgym_gallbladder_visual.stl"),
        pytest.param("human", "human/makehuman_base.obj", marks=pytest.mark.slow),
    ],
)
def test_built_in_scenes_say_how_their_files_lie_in_them(
    require_asset: Callable[[str], Path], scene: str, file: str
) -> None:
    """Vertices of the source lie on the surface at rest, but for what the scene leaves out or moves."""
    require_asset("human/makehuman_default.mhskel" if scene == "human" else file)
    loaded, mesh = load_scene(scene), read_segmented_mesh(require_asset(file))
    own = mesh.segments[0].vertices if scene != "human" else mesh.segments[mesh.names.index("body")].vertices
    distance = Solids(loaded.rest).nearest(transform_points(loaded.T_scene_source, own)).distance
    assert np.median(distance) < 0.05, np.median(distance)


def test_the_frame_survives_weights_and_older_ones_have_none(tmp_path: Path) -> None:
    model = scene_model(replace(load_scene("rope"), unit_m=0.25, T_scene_source=np.diag([2.0, 2.0, 2.0, 1.0])), 10)
    save_model(replace(untrained(model.rest.names), statistical_model=model), tmp_path / "w.safetensors")
    read = load_model(tmp_path / "w.safetensors").statistical_model
    assert read is not None and read.source_frame is not None and model.source_frame is not None
    np.testing.assert_array_equal(read.source_frame.T_scene_source, model.source_frame.T_scene_source)
    assert read.source_frame.unit_m == 0.25 and read.source_frame.scale == pytest.approx(2.0)
    tensors, facts = pack_model(model)
    assert unpack_model(tensors, {key: value for key, value in facts.items() if key != "frame"}).source_frame is None
