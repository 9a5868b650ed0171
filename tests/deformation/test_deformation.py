"""Every deformation: positive Jacobian, inverse, closed form, and the bounds beyond which it is refused."""

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from numpy.linalg import det, norm
from numpy.random import Generator, default_rng
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from mereo.deformation.maps import (
    Compose,
    Deformation,
    Identity,
    Localized,
    Rigid,
    invert,
    jacobian,
    jacobian_determinant,
    smooth_step,
)
from mereo.deformation.warps import (
    Bend,
    CurveSweep,
    FreeFormLattice,
    SmoothField,
    Squash,
    Taper,
    Twist,
    transport_frames,
)

HALF = 10.0
"""The random points fill the cube [-HALF, HALF]^3."""

REACH = HALF * 3**0.5
BOX = np.array([[-HALF] * 3, [HALF] * 3])


def direction(rng: Generator) -> ndarray:
    vector = rng.normal(size=3)
    return vector / norm(vector)


def make_bend(rng: Generator) -> Deformation:
    length = rng.uniform(5.0, 25.0)
    return Bend(np.zeros(3), direction(rng), direction(rng), length, rng.uniform(-0.9, 0.9) * length / REACH, REACH)


def make_window(rng: Generator) -> Deformation:
    inner = Rigid(rng.uniform(-0.4, 0.4, 3), rng.uniform(-0.8, 0.8, 3), np.zeros(3))
    return Localized(inner, np.zeros(3), 2.0, 9.0)


def make_sweep(rng: Generator) -> Deformation:
    """A slice of a helix of curvature 0.9 / REACH at most, so that the whole cube stays within its reach."""
    nodes = np.linspace(-HALF, HALF, 81)
    radius = REACH / 0.9
    rise = rng.uniform(0.0, 20.0)
    t = nodes / np.hypot(radius, rise)
    return CurveSweep.through(
        nodes, np.stack([radius * np.cos(t), radius * np.sin(t), rise * t], 1), direction(rng), REACH
    )


MAKERS = {
    "identity": lambda rng: Identity(),
    "rigid": lambda rng: Rigid(rng.uniform(-2, 2, 3), rng.uniform(-5, 5, 3), rng.uniform(-5, 5, 3)),
    "bend": make_bend,
    "twist": lambda rng: Twist(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(4, 20), rng.uniform(-2, 2)),
    "taper": lambda rng: Taper(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(4, 20), rng.uniform(0.4, 2.5)),
    "squash": lambda rng: Squash(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(0.4, 2.5)),
    "field": lambda rng: SmoothField.sample(rng, strength=0.9, wavelength=(8.0, 40.0)),
    "lattice": lambda rng: FreeFormLattice.sample(rng, BOX, (4, 3, 2), strength=0.95),
    "window": make_window,
    "sweep": make_sweep,
    "composition": lambda rng: Compose(tuple(MAKERS[name](rng) for name in ("field", "rigid", "squash", "taper"))),
}


def cube(rng: Generator, count: int = 300) -> ndarray:
    return rng.uniform(*BOX, size=(count, 3))


@pytest.mark.parametrize("name", MAKERS)
@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_jacobian_is_positive(name: str, seed: int) -> None:
    rng = default_rng(seed)
    deformation = MAKERS[name](rng)
    assert isinstance(deformation, Deformation)
    assert jacobian_determinant(deformation, cube(rng)).min() > 0


@pytest.mark.parametrize("name", MAKERS)
def test_points_move_independently_of_each_other(name: str) -> None:
    rng = default_rng(1)
    deformation = MAKERS[name](rng)
    points = cube(rng)
    before = points.copy()
    together = deformation(points)
    assert np.array_equal(points, before)
    assert np.allclose(together[3:4], deformation(points[3:4]), atol=1e-12)
    assert deformation(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("name", MAKERS)
def test_inverse_of_the_image_is_the_point(name: str) -> None:
    rng = default_rng(2)
    for _ in range(5):
        deformation = MAKERS[name](rng)
        points = cube(rng)
        guess = points + rng.normal(scale=0.3, size=points.shape)
        found, converged = invert(deformation, deformation(points), guess)
        assert converged.mean() > 0.99
        assert np.abs(deformation(found) - deformation(points))[converged].max() < 1e-5
        assert np.abs(found - points)[converged].max() < 1e-3


def test_damping_converges_where_newton_overshoots() -> None:
    """Newton's method for arctan x = 0 runs away from |x| > 1.39; with damping it comes back."""
    start = np.array([[3.0, -8.0, 2.0], [1.5, 10.0, -4.0]])
    found, converged = invert(np.arctan, np.zeros((2, 3)), start)
    assert converged.all() and np.abs(found).max() < 1e-5


def test_what_cannot_be_reached_is_reported() -> None:
    targets = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 3.0]])
    _, converged = invert(lambda points: points * [1.0, 1.0, 0.0], targets, targets.copy())
    assert converged.tolist() == [True, False]
    found, converged = invert(Identity(), np.empty((0, 3)), np.empty((0, 3)))
    assert found.shape == (0, 3) and converged.shape == (0,)


def test_jacobian_of_a_linear_map_is_its_matrix_at_any_scale() -> None:
    matrix = np.array([[1.0, 0.2, 0.0], [-0.3, 2.0, 0.1], [0.0, 0.5, 0.7]])
    for scale in (1e-3, 1.0, 1e4):
        points = default_rng(0).normal(scale=scale, size=(50, 3))
        value, found = jacobian(lambda p: p @ matrix.T, points)
        assert np.allclose(value, points @ matrix.T, rtol=1e-12, atol=0) and np.allclose(found, matrix, atol=1e-7)


def test_composition_applies_the_first_part_first() -> None:
    rng = default_rng(3)
    turn = MAKERS["rigid"](rng)
    twist = MAKERS["twist"](rng)
    points = cube(rng)
    assert np.array_equal(Compose((turn, twist))(points), twist(turn(points)))
    assert np.abs(Compose((turn, twist))(points) - Compose((twist, turn))(points)).max() > 0.1
    nested = Compose((Compose((turn, twist)), Compose(())))
    assert np.array_equal(nested(points), Compose((turn, twist))(points))
    product = jacobian_determinant(turn, points) * jacobian_determinant(twist, turn(points))
    assert np.allclose(jacobian_determinant(nested, points), product, atol=1e-5)


def test_bend_preserves_arc_length_and_has_the_closed_form_jacobian() -> None:
    bend = Bend(np.zeros(3), np.array([0.0, 0, 2]), np.array([1.0, 0, 5]), length=12.0, angle_rad=1.5, radius=7.0)
    axis = np.linspace(-5, 20, 4001)[:, None] * np.array([0, 0, 1.0])
    steps = norm(np.diff(bend(axis), axis=0), axis=1)
    assert np.isclose(steps.sum(), 25.0, rtol=1e-6)
    points = default_rng(5).uniform([-7, -7, 0.1], [7, 7, 11.9], size=(500, 3))
    assert np.allclose(jacobian_determinant(bend, points), 1 - 1.5 / 12 * points[:, 0], atol=1e-4)


def test_bend_is_a_circle_between_rigid_ends() -> None:
    bend, straight = (Bend(np.zeros(3), *np.eye(3)[[2, 0]], length=12.0, angle_rad=a, radius=7.0) for a in (1.5, 0.0))
    arc = bend(np.linspace(0, 12, 50)[:, None] * np.array([0, 0, 1.0]))
    assert np.allclose(norm(arc - np.array([8.0, 0, 0]), axis=1), 8.0)
    before = np.array([[1.0, 2, -3], [-4, 1, -8]])
    assert np.allclose(bend(before), before)
    # turned by the angle about y, from z towards x
    after = np.array([[1.0, 2, 15], [-4, 1, 13], [0, 0, 12]])
    turned = Rotation.from_rotvec([0, 1.5, 0]).apply(after - after[2])
    assert np.allclose(bend(after) - bend(after)[2], turned)
    assert np.allclose(straight(after), after)


def test_twist_and_squash_preserve_volume_and_taper_scales_by_the_square() -> None:
    rng = default_rng(6)
    points = cube(rng)
    for make in (MAKERS["twist"], MAKERS["squash"]):
        assert np.allclose(jacobian_determinant(make(rng), points), 1.0, atol=1e-4)
    taper = Taper(np.zeros(3), np.array([0.0, 1, 0]), 8.0, 0.5)
    factor = 1 - 0.5 * smooth_step(points[:, 1] / 8)
    assert np.allclose(jacobian_determinant(taper, points), factor**2, atol=1e-4)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), strength=st.floats(0.05, 0.95))
def test_smooth_field_changes_distances_within_its_bound(seed: int, strength: float) -> None:
    """The theorem behind the diffeomorphism: (1 - g) |x - y| <= |f(x) - f(y)| <= (1 + g) |x - y|."""
    rng = default_rng(seed)
    field = SmoothField.sample(rng, strength, (5.0, 30.0))
    assert np.isclose(field.gradient_bound, strength)
    x = cube(rng)
    y = cube(rng) * rng.choice([1e-2, 1.0])
    ratio = norm(field(x) - field(y), axis=1) / norm(x - y, axis=1)
    assert ratio.min() >= 1 - strength - 1e-9 and ratio.max() <= 1 + strength + 1e-9


def test_lattice_equals_the_sum_of_b_splines() -> None:
    rng = default_rng(7)
    lattice = MAKERS["lattice"](rng)
    points = cube(rng, 40) * 1.6
    at = (points - lattice.origin) / lattice.spacing
    basis = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    expected = points.copy()
    for index in np.ndindex(lattice.displacements.shape[:3]):
        weight = np.nan_to_num(basis(at - np.array(index))).prod(axis=1)
        expected += weight[:, None] * lattice.displacements[index]
    assert np.allclose(lattice(points), expected, atol=1e-10)
    far = points + 60.0
    assert np.array_equal(lattice(far), far)


def test_lattice_at_its_limit_stays_positive_even_when_neighbours_oppose() -> None:
    """Each of the 4^3 control points around a cell takes the sign that pushes against its gradient."""
    signs = np.sign(np.arange(8) - 3.5)
    spacing = np.full(3, 5.0)
    limit = 5.0 / 2.4801
    grid = np.stack(np.meshgrid(-signs, -signs, -signs, indexing="ij"), axis=-1)
    lattice = FreeFormLattice(np.zeros(3), spacing, limit * grid)
    points = default_rng(8).uniform(12.0, 23.0, size=(4000, 3))
    determinant = jacobian_determinant(lattice, points)
    assert 0 < determinant.min() < 0.1
    with pytest.raises(ValueError, match="must stay below 0.403"):
        FreeFormLattice(np.zeros(3), spacing, 1.01 * limit * grid)


def test_window_is_its_inner_map_inside_and_nothing_outside() -> None:
    rng = default_rng(9)
    inner = Rigid(np.array([0.0, 0, 0.3]), np.array([0.5, 0, 0]), np.zeros(3))
    window = Localized(inner, np.ones(3), 3.0, 9.0)
    points = cube(rng, 4000)
    distance = norm(points - 1.0, axis=1)
    assert np.allclose(window(points)[distance < 3], inner(points)[distance < 3])
    assert np.array_equal(window(points)[distance > 9], points[distance > 9])


def test_sweep_onto_a_circle_is_a_torus() -> None:
    angle = np.linspace(0, 1.5 * pi, 400)
    centers = 10.0 * np.stack([np.sin(angle), 1 - np.cos(angle), np.zeros_like(angle)], axis=1)
    sweep = CurveSweep.through(10.0 * angle, centers, np.array([0.0, 1, 0]), radius=4.0)
    rng = default_rng(10)
    x, y, z = rng.uniform([0, -4, -4], [15 * pi, 4, 4], size=(500, 3)).T
    t, ring = x / 10.0, 10.0 - y
    expected = np.stack([ring * np.sin(t), 10 - ring * np.cos(t), z], axis=1)
    points = np.stack([x, y, z], axis=1)
    assert np.allclose(sweep(points), expected, atol=1e-4)
    assert np.allclose(jacobian_determinant(sweep, points), 1 - y / 10, atol=1e-3)
    # straight before the start (the identity here) and beyond the end (three quarters round: heading along -y)
    assert np.allclose(sweep(np.array([[-5.0, 2, 1]])), [[-5.0, 2, 1]], atol=1e-4)
    assert np.allclose(sweep(np.array([[15 * pi + 5.0, 0, 1]])), [[-10.0, 5.0, 1]], atol=1e-4)


def test_transported_frames_are_rotations_that_do_not_twist() -> None:
    t = np.linspace(0, 4 * pi, 2000)
    tangents = np.stack([-np.sin(t), np.cos(t), np.full_like(t, 0.5)], axis=1) / np.hypot(1, 0.5)
    frames = transport_frames(tangents, np.array([1.0, 1.0, 0.3]))
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3)) and np.allclose(det(frames), 1)
    assert np.allclose(frames[:, 0], tangents)
    twist = np.einsum("ni,ni->n", np.gradient(frames[:, 1], t, axis=0), frames[:, 2])
    assert np.abs(twist[2:-2]).max() < 1e-4
    # after a turn of the helix the frame has turned by the solid angle its tangents enclose: 2 pi (1 - sin(pitch))
    turn = Rotation.from_matrix(frames[999].T @ frames[0]).magnitude()
    enclosed = 2 * pi * (1 - 0.5 / np.hypot(1, 0.5))
    assert np.isclose(turn, min(enclosed, 2 * pi - enclosed), atol=0.02)


ORIGIN = np.zeros(3)
Z = np.array([0.0, 0.0, 1.0])
REFUSED = {
    "bend": (
        lambda: Bend(ORIGIN, *np.eye(3)[[2, 0]], 4.0, 2.0, 3.0),
        "curvature 0.5 times radius 3 is 1.5; it must be below 1 .*: bend less sharply or make the object thinner",
    ),
    "direction": (lambda: Twist(ORIGIN, ORIGIN, 1.0, 1.0)(np.ones((1, 3))), "direction .* no finite length above 0"),
    "taper": (lambda: Taper(ORIGIN, np.ones(3), 1.0, 0.0), "the scale factor is 0; it must be above 0 .*positive"),
    "field": (
        lambda: SmoothField(np.array([[2.0, 0, 0]]), np.array([[0.6, 0, 0]]), np.zeros(1)),
        "the waves' gradient may reach 1.2; it must stay below 1 .*: make the amplitudes smaller",
    ),
    "window": (
        lambda: Localized(Rigid(ORIGIN, np.array([6.0, 0, 0]), ORIGIN), ORIGIN, 1.0, 5.0),
        "the deformation Localized scales volume by .*; it must be at least 0.02 or space folds over: make its",
    ),
    "window radii": (
        lambda: Localized(Identity(), ORIGIN, 5.0, 5.0),
        "the window's radii are 5 and 5; they must be at least 0 and grow outwards: enlarge outer_radius",
    ),
    "sweep": (
        lambda: CurveSweep.through(np.arange(5.0), np.array([[np.cos(t), np.sin(t), 0] for t in range(5)]), Z, 2.0),
        "curvature .* times radius 2 is .*; it must be below 1",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_parameters_that_would_fold_space_are_refused(case: str) -> None:
    make, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        make()
