"""The sheet folds over itself, in every kind of state, and layers keep apart."""

import numpy as np
import pytest
from manifold3d import Manifold, OpType
from solid_pairs import crowded

from mereo.deformation.maps import Deformation, jacobian
from mereo.geometry.mesh_check import solid_of
from mereo.scenes.registry import load_scene
from mereo_objects import sheet
from mereo_objects._sheet_parts import THICKNESS, middle_points


def underside_share(deformation: Deformation) -> float:
    """How much of the sheet shows its other side from above than the rest does."""
    _, matrix = jacobian(deformation, middle_points())
    normals = np.cross(matrix[:, :, 0], matrix[:, :, 1])
    up = normals[:, 2] / np.linalg.norm(normals, axis=1)
    return float(min((up < -0.2).mean(), (up > 0.2).mean()))


def first_of_kind(kind: str, seed: int) -> Deformation:
    rng = np.random.default_rng(seed)
    return next(found for found in iter(lambda: sheet.sample_deformation(rng, kind), object()) if found is not None)


@pytest.mark.parametrize("kind", sheet.KINDS[1:])
def test_folds_and_rolls_turn_part_of_the_sheet_over(kind: str) -> None:
    shares = [underside_share(first_of_kind(kind, seed)) for seed in range(8)]
    assert np.median(shares) > 0.05 and max(shares) > 0.15


def test_most_states_fold_over() -> None:
    rng = np.random.default_rng(1)
    shares = np.array([underside_share(sheet.sample_deformations(rng)[0]) for _ in range(40)])
    assert (shares > 0.03).mean() > 0.7


def test_layers_keep_apart_in_every_state() -> None:
    scene, rng = load_scene("sheet"), np.random.default_rng(2)
    for _ in range(10):
        mesh = scene.sample_state(rng).mesh
        assert not crowded(mesh, 0.05)


def test_a_sheet_that_lies_on_itself_is_refused() -> None:
    flat = middle_points()
    assert sheet.is_clear(flat)
    folded = np.where(flat[:, :1] > 0, flat * [-1.0, 1.0, 1.0] + [0.0, 0.0, THICKNESS], flat)
    assert not sheet.is_clear(folded)


def test_half_a_cell_through_its_thickness_costs_the_flat_mat_a_quarter() -> None:
    rest = load_scene("sheet").rest
    mat = Manifold.batch_boolean([solid_of(part.vertices, part.faces) for part in rest.segments], OpType.Add)
    half_a_cell = float((rest.bounds[1] - rest.bounds[0]).max()) / 100 / 2
    shared = (mat ^ mat.translate((0.0, 0.0, half_a_cell))).volume()
    assert shared / (2 * mat.volume() - shared) == pytest.approx(0.72, abs=0.005)


def test_the_middle_surface_keeps_its_lengths() -> None:
    """Bends and sweep are isometries there; twist, waves and tilt change little."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        _, matrix = jacobian(sheet.sample_deformations(rng)[0], middle_points())
        stretch = np.linalg.norm(matrix[:, :, :2], axis=1)
        assert np.quantile(stretch, 0.02) > 0.6 and np.quantile(stretch, 0.98) < 1.4
