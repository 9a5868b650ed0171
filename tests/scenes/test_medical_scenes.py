"""The scenes of organs and bones: repaired meshes, bites without penetration, a hidden tumour."""

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from overlapping import check_overlap

from mereo.geometry.mesh_check import solid_of
from mereo.geometry.mesh_repair import close_holes, largest_piece
from mereo.geometry.solids import Solids
from mereo.scenes.registry import load_scene
from mereo_objects import _liver_parts, skull, tumor

Require = Callable[[str], Path]


@pytest.fixture
def organs(require_asset: Require) -> None:
    require_asset("liver/lapgym_liver_visual.stl"), require_asset("liver/lapgym_gallbladder_visual.stl")


@pytest.fixture
def bones(require_asset: Require) -> None:
    require_asset("skull/sofa_skull_and_teeth_coarse.obj")


# --- repair -----------------------------------------------------------------------------------------------------------


def test_repair_keeps_the_largest_piece_and_closes_its_hole() -> None:
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]  # one side is missing
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    stray = np.array([[0, 8, 9]])  # shares a vertex, but no edge
    vertices = np.concatenate([cube, [[5.0, 5, 5], [6, 5, 5]]])
    kept = largest_piece(vertices, np.concatenate([stray, faces]))
    assert [len(part) for part in kept] == [8, 10]
    closed = close_holes(*kept)
    assert [len(part) for part in closed] == [9, 14]
    assert solid_of(*closed).volume() == pytest.approx(1.0)
    again = close_holes(*closed)
    assert again[0] is closed[0] and again[1] is closed[1]
    with pytest.raises(ValueError, match="a mesh of 10 faces is no solid .NotManifold.; it must be closed"):
        solid_of(*kept)


@pytest.mark.usefixtures("organs")
def test_the_repaired_liver_is_the_known_one() -> None:
    """Faces, volume and box of a repair of the same file that was made by other means; one piece without handles."""
    vertices, faces = _liver_parts.repaired_liver()
    solid = solid_of(vertices, faces)
    assert len(faces) == 28_560 and solid.genus() == 0 and len(solid.decompose()) == 1
    assert solid.volume() == pytest.approx(1_762_141.0, abs=0.1)  # cubic millimetres
    assert_allclose(np.ptp(vertices, axis=0), [162.675, 202.286, 197.815], atol=1e-3)


# --- skull ------------------------------------------------------------------------------------------------------------


def signed(solids: Solids, index: int, points: ndarray) -> ndarray:
    return np.where(solids.inside(index, points), -1, 1) * solids.segment_distance(index, points)


@pytest.mark.usefixtures("bones")
def test_the_jaw_never_touches_the_skull() -> None:
    """At the corners of the range of motion: closed, ajar, wide; forward; to both sides."""
    rest = skull.rest_mesh()
    condyles = skull.condyles()
    upper, cranium = rest.segments[:2]
    still = Solids(rest)
    for share, forward, side in product((0.0, 0.1, 0.21, 0.6, 1.0), (0, 1), (-1, 0, 1)):
        open_rad, protrusion, lateral_rad = skull.jaw_state(share, forward, side)
        jaw = skull.jaw_motion(condyles, open_rad, protrusion, lateral_rad)
        state = rest.with_vertices([s.vertices if i < 2 else jaw(s.vertices) for i, s in enumerate(rest.segments)])
        moved = [segment.vertices for segment in state.segments[2:]]
        assert min(signed(still, index, points).min() for index in (0, 1) for points in moved) > 0.09
        turned = Solids(state)
        around = cranium.vertices[cranium.vertices[:, 2] > 0.0]
        assert min(signed(turned, index, upper.vertices).min() for index in (2, 3)) > 0.09
        assert signed(turned, 3, around).min() > 0.09
        if share == 1.0 and forward == side == 0:
            gap = upper.vertices[:, 0].min() - moved[0][:, 0].max()
            assert 1.0 < gap < 6.0, "the mouth is open by 8 to 50 mm"


@pytest.mark.usefixtures("bones")
def test_a_closed_jaw_neither_slides_nor_turns() -> None:
    assert skull.jaw_state(0.0, 1.0, 1.0) == (0.0, 0.0, 0.0)
    states = np.array([skull.sample_jaw(default_rng(seed)) for seed in range(400)])
    assert 0.08 < (states[:, 0] == 0).mean() < 0.22
    assert states[:, 0].max() <= skull.OPEN_RAD and states[:, 1].min() >= 0
    assert np.abs(states[:, 2]).max() <= skull.LATERAL_RAD


# --- liver and tumour -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("organs")
def test_the_tumour_stays_hidden_in_the_liver() -> None:
    scene = load_scene("tumor")
    rng = default_rng(2)
    assert scene.rest.nested == (("tumor", "liver"),)
    depth = Solids(scene.rest).segment_distance(1, scene.rest.segments[0].vertices) / _liver_parts.MM
    assert depth.min() > 20
    for _ in range(5):
        mesh = scene.sample_state(rng).mesh
        check_overlap(mesh, tolerance=1e-3)
        assert Solids(mesh).inside(1, mesh.segments[0].vertices).all()


@pytest.mark.usefixtures("organs")
def test_the_tumours_place_and_size_vary_within_their_bounds() -> None:
    rng = default_rng(3)
    rest = tumor.rest_mesh()
    inner, outer = rest.segments[0].vertices, rest.segments[1].vertices
    shifts, factors = [], []
    for _ in range(60):
        placed = tumor.sample_placement(rng)
        moved = placed(inner)
        shifts.append(norm(placed(placed.center[None])[0] - placed.center) / _liver_parts.MM)
        factors.append(float(np.ptp(moved[:, 0]) / np.ptp(inner[:, 0])))
        assert np.abs(placed(outer) - outer).max() < 1.0 * _liver_parts.MM, "nothing of it shows on the surface"
    assert max(shifts) <= 4.0 + 1e-9 and max(shifts) > 3.0
    assert 0.85 - 1e-9 <= min(factors) < 0.9 and 1.1 < max(factors) <= 1.15 + 1e-9
