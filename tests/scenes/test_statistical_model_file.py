"""Statistical models survive their file up to rounding, travel with weights, and fit into them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from folder_contents import run_mereo
from numpy.testing import assert_allclose

from mereo.cli.scenes import SceneModes
from mereo.deformation.maps import Identity
from mereo.models.weights import save_model
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
    return scene_model(load_scene("rope"), 100)


def test_a_model_survives_its_file_up_to_rounding(rope: StatisticalModel, tmp_path: Path) -> None:
    save_statistical_model(rope, tmp_path / "m.safetensors")
    read = load_statistical_model(tmp_path / "m.safetensors")
    assert rope.count > WIDE_MODES
    steps = np.abs(rope.modes).max(axis=(0, 1)) / np.where(np.arange(rope.count) < WIDE_MODES, 32767, 127)
    assert (np.abs(read.modes - rope.modes) <= 0.51 * steps + 1e-7).all()
    assert np.abs(read.library - np.clip(rope.library, -4, 4)).max() <= 1 / 32
    assert np.array_equal(read.mean, rope.mean.astype(np.float32))
    assert np.array_equal(read.pairs.first, rope.pairs.first) and np.allclose(read.pairs.std, rope.pairs.std)
    found, expected = read.rest, rope.rest
    assert (found.names, found.colors, found.nested) == (expected.names, expected.colors, expected.nested)
    for one, other in zip(found.segments, expected.segments, strict=True):
        assert np.array_equal(one.faces, other.faces) and one.solid == other.solid
        assert np.array_equal(one.vertices, other.vertices.astype(np.float32))


def test_what_fewer_modes_leave_out_is_residue(rope: StatisticalModel) -> None:
    few = with_fewer_modes(rope, 5)
    assert few.count == 5 and with_fewer_modes(rope, 1000) is rope
    lost = (rope.modes[..., 5:].astype(float) ** 2).sum() / len(rope.mean)
    assert few.residue**2 == pytest.approx(rope.residue**2 + lost)
    for count in (0, 1, rope.count // 2, rope.count):
        assert rope.residues[count] == pytest.approx(with_fewer_modes(rope, count).residue, rel=1e-6)
    assert (np.diff(rope.residues) < 0).all() and (np.diff(rope.explained) > 0).all()


@pytest.mark.parametrize("spare", [0, 40_000, 10**9])
def test_as_many_modes_as_fit(rope: StatisticalModel, spare: int) -> None:
    def size(model: StatisticalModel) -> int:
        return sum(value.nbytes for value in pack_model(model)[0].values())

    limit = size(with_fewer_modes(rope, WIDE_MODES)) + spare
    most = modes_within(rope, limit)
    assert size(with_fewer_modes(rope, most)) <= limit
    assert most == rope.count or size(with_fewer_modes(rope, most + 1)) > limit


def test_an_object_that_does_not_deform_has_no_modes_and_another_file_is_refused(tmp_path: Path) -> None:
    still = replace(load_scene("rope"), sample_deformations=lambda _: (Identity(),) * 9)
    save_statistical_model(scene_model(still, 20), tmp_path / "m.safetensors")
    read = load_statistical_model(tmp_path / "m.safetensors")
    assert read.count == 0 and read.residue < 1e-5
    assert_allclose(read.material(np.zeros(0)), read.rest_points, atol=1e-4)
    (tmp_path / "m.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"m.safetensors is no statistical model of mereo \(.*\); delete it and run"):
        load_statistical_model(tmp_path / "m.safetensors")


def test_the_number_of_modes_needed_is_the_smallest_that_is_enough(rope: StatisticalModel) -> None:
    count = rope.modes_for(1.0)
    assert count is not None and rope.residues[count] <= 1.0 < rope.residues[count - 1]
    assert rope.modes_for(np.inf) == 0 and rope.modes_for(rope.residue / 2) is None


def test_the_command_says_how_many_also_of_weights(
    rope: StatisticalModel, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert run_mereo("scene", "modes", "rope", "--states", "100") == 0
    assert "modes leave" in capsys.readouterr().out
    with pytest.raises(ValueError, match="fewer than 100 say little"):
        SceneModes("rope", states=5).run()
    network = replace(untrained(rope.rest.names), provenance={"scene": "rope"})
    save_model(replace(network, statistical_model=rope), tmp_path / "with.safetensors")
    SceneModes(str(tmp_path / "with.safetensors"), states=100).run()
    assert f"{rope.count} modes" in capsys.readouterr().out
    save_model(network, tmp_path / "without.safetensors")
    with pytest.raises(ValueError, match="carries no statistical model: name the scene"):
        SceneModes(str(tmp_path / "without.safetensors"), states=100).run()
