"""A registration's state as a file: the same material points again, and one sentence for what is none."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folder_contents import read_json
from numpy.random import Generator
from numpy.testing import assert_allclose, assert_array_equal
from registered_states import SCENE, T, by_modes, placed

from mereo.fitting.draws.playback import Drawn, material_moved
from mereo.fitting.registration.registration import Registration
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.results.state import (
    STATE,
    load_state,
    model_digest,
    read_state,
    restored,
    save_state,
    state_of,
)
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel


def by_draws(model: StatisticalModel, scene: Scene = SCENE, seed: int = 5) -> Registration:
    """Draws that a fit has moved away from those of their seed."""
    drawn = Drawn.of(scene, seed)
    z = np.where(drawn.smooth, 0.8 * drawn.z + 0.1, drawn.z)
    unposed = material_moved(scene, model, drawn.deformations(scene, z))
    return placed(model, unposed, method="draws", z=z, drawn=replace(drawn, z=z))


def assert_same(again: Registration, before: Registration) -> None:
    size = np.ptp(before.material, axis=0).max()
    assert np.abs(again.material - before.material).max() <= 1e-6 * size
    assert (again.method, again.scene_unit, again.explained) == (before.method, before.scene_unit, before.explained)
    assert (again.accepted, again.seconds, again.unit_known) == (before.accepted, before.seconds, True)
    assert_array_equal(again.z, before.z)


@pytest.mark.parametrize("make", [by_modes, by_draws])
def test_a_state_gives_the_same_material_points_again(
    make: Callable[[StatisticalModel], Registration], model: StatisticalModel, tmp_path: Path
) -> None:
    before = make(model)
    save_state(tmp_path / STATE, state_of(before, SCENE, weights="toy", frame="scanner", unit_m=0.001))
    again = load_state(tmp_path, model, SCENE)
    assert_same(again, before)
    state = read_state(tmp_path / STATE)
    assert (state.scene, state.weights, state.frame, state.unit_m) == ("toy", "toy", "scanner", 0.001)
    assert_allclose(np.array(state.T_camera_model), T, atol=1e-9)
    points = model.rest_points[::50]
    assert_allclose(again.to_camera(points), before.to_camera(points), atol=1e-6)
    assert (tmp_path / STATE).stat().st_size < 5000


def test_a_state_of_other_weights_is_refused(model: StatisticalModel) -> None:
    state = state_of(by_modes(model), "toy", weights="mine.safetensors")
    modes = model.modes.copy()
    modes[0, 0, 0] += 1e-3
    with pytest.raises(ValueError, match="model of other weights .*'mine.safetensors'.* the model of those weights"):
        restored(state, replace(model, modes=modes))


def test_a_scene_that_has_changed_since_is_said(model: StatisticalModel) -> None:
    def wider(rng: Generator) -> Any:
        deformations = SCENE.sample_deformations(rng)
        shear = replace(deformations[0], a=deformations[0].a + 1.0)  # type: ignore[type-var]
        return (shear, shear, shear, replace(deformations[3], then=shear))  # type: ignore[type-var]

    state = state_of(by_draws(model), SCENE)
    with pytest.raises(ValueError, match="scene units away from where .* 'toy' has changed since"):
        restored(state, model, replace(SCENE, sample_deformations=wider))
    with pytest.raises(ValueError, match="the scene 'toy' does not take these 2 draws"):
        restored(state, model, replace(SCENE, sample_deformations=lambda rng: (rng.random(), rng.random())))
    with pytest.raises(ValueError, match="the state is one of the scene 'toy', not of 'other'"):
        restored(state, model, replace(SCENE, name="other"))
    with pytest.raises(ValueError, match="one of draws; the scene that is played is needed, not its name 'toy'"):
        state_of(by_draws(model), "toy")


def test_a_name_in_a_file_runs_no_code(model: StatisticalModel, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    (tmp_path / "evil.py").write_text(f"open({str(ran)!r}, 'w')\n")
    state = state_of(by_draws(model), SCENE).model_copy(update={"scene": str(tmp_path / "evil.py")})
    with pytest.raises(ValueError, match="which is not built in: give the scene"):
        restored(state, model)
    assert not ran.exists()


# what is wrong in a file, and where
WRONG = {
    "key": (lambda facts: {**facts, "extra": 1}, "'extra'"),
    "large": (lambda facts: {**facts, "z": [1e9]}, "'z.0'"),
    "format": (lambda facts: {**facts, "format": 2}, "its format is 2; this mereo reads format 1"),
    "method": (lambda facts: {**facts, "method": "draws"}, "the block `draws` belongs to the method 'draws' alone"),
    "unit": (lambda facts: {**facts, "scene_unit": 0.0}, "'scene_unit'"),
    "mirror": (lambda facts: {**facts, "T_camera_input": np.diag([1, 1, -1, 1]).tolist()}, "must be a rigid transform"),
    "lengths": (
        lambda facts: {**facts, "method": "draws", "draws": {"seed": 1, "sizes": [1], "names": ["a"]}},
        "must be of one length",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_value_is_refused_in_one_sentence(kind: str, model: StatisticalModel, tmp_path: Path) -> None:
    path, (change, where) = tmp_path / STATE, WRONG[kind]
    save_state(path, state_of(by_modes(model), "toy"))
    path.write_text(json.dumps(change(read_json(path))))
    with pytest.raises(ValueError, match="is no state of a registration.*: give the state.json of") as error:
        read_state(path)
    assert where in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 400


def test_folders_without_a_state_and_with_a_hostile_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="`mereo reconstruct` writes it where the answer is a registered model"):
        read_state(tmp_path)
    for content in (b"[" * 200_000, b'{"z": NaN}', b"{}" + b" " * 2**20):
        (tmp_path / STATE).write_bytes(content)
        with pytest.raises(ValueError, match="is no state of a registration") as error:
            read_state(tmp_path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_a_damaged_number_of_coefficients_is_said(model: StatisticalModel) -> None:
    state = state_of(by_modes(model), "toy")
    short = state.model_copy(update={"z": state.z[:-1]})
    with pytest.raises(ValueError, match=f"has {model.count - 1} coefficients, but the model has {model.count} modes"):
        restored(short, model)
    moved = state.model_copy(update={"z": (state.z[0] + 1, *state.z[1:])})
    with pytest.raises(ValueError, match="has changed since, or the file: register the frame again"):
        restored(moved, model)


@pytest.mark.slow
def test_a_built_in_scene_is_found_by_its_name(tmp_path: Path) -> None:
    scene = load_scene("rope")
    model = scene_model(scene, count=20)
    before = by_draws(model, scene)
    save_state(tmp_path / STATE, state_of(before, scene))
    assert_same(load_state(tmp_path, model), before)


def test_weights_keep_the_digest_of_their_model(rope: Model, tmp_path: Path) -> None:
    save_model(rope, tmp_path / "r.safetensors")
    one, other = (load_model(tmp_path / "r.safetensors").statistical_model for _ in range(2))
    assert model_digest(one) == model_digest(other)
    state = state_of(by_modes(one), "rope")
    assert_same(restored(state, other), by_modes(one))
