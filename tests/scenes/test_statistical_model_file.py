"""Statistical models survive their file up to rounding, travel with weights, and fit into them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import untrained

from mereo.deformation.maps import Identity
from mereo.geometry.mesh import SegmentedMesh
from mereo.models.weights import load_model, save_model, weights_bytes
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import (
    WIDE_MODES,
    StatisticalModel,
    load_statistical_model,
    modes_within,
    pack_model,
    save_statistical_model,
    with_fewer_modes,
)


@pytest.fixture(scope="module")
def rope() -> StatisticalModel:
    return scene_model(load_scene("rope"), 60)


def test_a_model_survives_its_file_up_to_rounding(rope: StatisticalModel, tmp_path: Path) -> None:
    save_statistical_model(rope, tmp_path / "m.safetensors")
    read = load_statistical_model(tmp_path / "m.safetensors")
    assert rope.count > WIDE_MODES
    steps = np.abs(rope.modes).max(axis=(0, 1)) / np.where(np.arange(rope.count) < WIDE_MODES, 32767, 127)
    assert (np.abs(read.modes - rope.modes) <= 0.51 * steps + 1e-7).all()
    assert np.abs(read.library - np.clip(rope.library, -4, 4)).max() <= 1 / 32
    assert np.array_equal(read.mean, rope.mean.astype(np.float32))
    assert np.array_equal(read.pairs.first, rope.pairs.first) and np.allclose(read.pairs.std, rope.pairs.std)
    same_rest(read.rest, rope.rest)


def same_rest(found: SegmentedMesh, expected: SegmentedMesh) -> None:
    assert (found.names, found.colors, found.nested) == (expected.names, expected.colors, expected.nested)
    for one, other in zip(found.segments, expected.segments, strict=True):
        assert np.array_equal(one.faces, other.faces) and one.solid == other.solid
        assert np.array_equal(one.vertices, other.vertices.astype(np.float32))


def test_what_fewer_modes_leave_out_is_residue(rope: StatisticalModel) -> None:
    few = with_fewer_modes(rope, 5)
    assert few.count == 5 and with_fewer_modes(rope, 1000) is rope
    lost = (rope.modes[..., 5:].astype(np.float64) ** 2).sum() / len(rope.mean)
    assert few.residue**2 == pytest.approx(rope.residue**2 + lost)


@pytest.mark.parametrize("spare", [0, 40_000, 10**9])
def test_as_many_modes_as_fit(rope: StatisticalModel, spare: int) -> None:
    def size(model: StatisticalModel) -> int:
        return sum(value.nbytes for value in pack_model(model)[0].values())

    limit = size(with_fewer_modes(rope, WIDE_MODES)) + spare
    most = modes_within(rope, limit)
    assert size(with_fewer_modes(rope, most)) <= limit
    assert most == rope.count or size(with_fewer_modes(rope, most + 1)) > limit


def test_weights_carry_the_model(rope: StatisticalModel, tmp_path: Path) -> None:
    model = replace(untrained(rope.rest.names), statistical_model=rope)
    save_model(model, tmp_path / "w.safetensors", torch.float16)
    read = load_model(tmp_path / "w.safetensors")
    assert read.statistical_model is not None
    same_rest(read.statistical_model.rest, rope.rest)
    without = replace(model, statistical_model=None)
    assert load_model(save(without, tmp_path / "v.safetensors")).statistical_model is None
    assert len(weights_bytes(model)) > len(weights_bytes(without))


def save(model: object, path: Path) -> Path:
    save_model(model, path)  # type: ignore[arg-type]
    return path


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"m.safetensors is no statistical model of mereo \(.*\); delete it and run"):
        load_statistical_model(tmp_path / "m.safetensors")


def test_an_object_that_does_not_deform_has_no_modes(tmp_path: Path) -> None:
    still = replace(load_scene("rope"), sample_deformations=lambda _: (Identity(),) * 9)
    save_statistical_model(scene_model(still, 20), tmp_path / "m.safetensors")
    read = load_statistical_model(tmp_path / "m.safetensors")
    assert read.count == 0 and read.residue < 1e-5
    np.testing.assert_allclose(read.material(np.zeros(0)), read.rest_points, atol=1e-4)
