"""Elastic modes: theorems of the free solid, whatever its shape; and what is no solid is refused in a sentence."""

import pickle
from dataclasses import replace
from functools import cache
from math import nan

import numpy as np
import pytest
from lattice import fine, lattice
from numpy import ndarray
from numpy.random import default_rng
from numpy.testing import assert_allclose
from shapes import box

from mereo.deformation.elastic import (
    LEAST_RATIO,
    MOST_SWELLING,
    ElasticSampler,
    ElasticSolid,
    Material,
    StateMap,
    assemble_stiffness,
    build_lattice,
    find_modes,
    scale_modes,
)
from mereo.geometry.mesh import Segment, SegmentedMesh

COUNT = 20


def block(scale: float = 1.0) -> SegmentedMesh:
    """A bent block whose three sides differ, so that no two modes have the same eigenvalue."""
    part = fine((0.0, 0.0, 0.0), (5.0, 3.0, 1.7), "block", 0)
    x, y, z = part.vertices.T
    vertices = scale * np.stack([x, y + 0.08 * x**2, z + 0.1 * y], axis=1)
    return SegmentedMesh((Segment("block", (0, 0, 0), vertices, part.faces),))


@cache
def solid(scale: float = 1.0) -> ElasticSolid:
    return build_lattice(block(scale), 8)


def partly_filled() -> ElasticSolid:
    """Tetrahedra of both orientations, each filled by another share."""
    mesh = lattice()
    return ElasticSolid(mesh, default_rng(1).uniform(0.1, 1.0, size=len(mesh.elements)))


@cache
def modes(scale: float = 1.0, young: float = 1.0) -> tuple[ndarray, ndarray]:
    return find_modes(solid(scale), COUNT, Material(young=young))


def covariance(scale: float = 1.0, young: float = 1.0, power: float = 2.0) -> ndarray:
    """Of all nodes' coordinates, which no sign or order of modes changes."""
    flat = scale_modes(*modes(scale, young), motion=0.2 * scale, power=power).reshape(-1, COUNT)
    return flat @ flat.T


def test_the_lattice_holds_the_mesh_and_its_volume() -> None:
    mesh = block()
    made = solid()
    assert (made.mesh.locate(mesh.segments[0].vertices) >= 0).all()
    assert_allclose(made.volumes.sum(), mesh.segments[0].volume, rtol=0.05)
    assert_allclose(made.mass.sum(), made.volumes.sum(), rtol=1e-12)
    assert_allclose(np.abs(made.mesh.volumes), (5.0 / 8) ** 3 / 6, rtol=1e-9)


def test_points_of_the_mesh_follow_affine_motions_of_the_nodes() -> None:
    points = np.concatenate([block().segments[0].vertices, solid().mesh.nodes])
    assert_allclose(solid().mesh.embed(points) @ solid().mesh.nodes, points, atol=1e-12)
    outside = np.array([[-2.0, 0.4, 0.3], [9.0, 3.0, 1.0]])
    _, _, closest = solid().mesh.closest(outside)
    assert_allclose(solid().mesh.embed(outside) @ solid().mesh.nodes, closest, atol=1e-12)


@pytest.mark.parametrize("poisson", [-0.3, 0.0, 0.4])
def test_stiffness_is_symmetric_and_rigid_motions_cost_nothing(poisson: float) -> None:
    body = partly_filled()
    stiffness = assemble_stiffness(body, Material(poisson))
    most = np.abs(stiffness).max()
    assert np.abs(stiffness - stiffness.T).max() <= 1e-12 * most
    axes = np.broadcast_to(np.eye(3)[:, None], (3, len(body.mesh.nodes), 3))
    turns = np.cross(axes, body.mesh.nodes)
    for motion in (*axes, *turns):
        assert np.abs(stiffness @ motion.ravel()).max() <= 1e-11 * most
    energies = np.linalg.eigvalsh(stiffness.toarray())
    assert np.abs(energies[:6]).max() < 1e-12 < 1e-3 < energies[6], "and nothing else is free"


def test_a_stretch_costs_its_strain_energy() -> None:
    """Closed form: E (1 - nu) / ((1 + nu) (1 - 2 nu)) e^2 / 2 for each unit of filled volume."""
    body = partly_filled()
    nu = 0.3
    stretch = 0.01
    motion = np.zeros_like(body.mesh.nodes)
    motion[:, 0] = stretch * body.mesh.nodes[:, 0]
    energy = motion.ravel() @ (assemble_stiffness(body, Material(nu, young=7.0)) @ motion.ravel()) / 2
    density = 7.0 * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) * stretch**2 / 2
    assert energy == pytest.approx(density * body.volumes.sum(), rel=1e-10)


def checked_columns(values: np.ndarray, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modes as columns, and weighed by the mass, in which they are orthonormal."""
    assert (np.diff(values) >= 0).all() and values[0] > 0
    flat = vectors.reshape(-1, COUNT)
    weighed = np.repeat(solid().mass, 3)[:, None] / solid().mass.sum() * flat
    assert_allclose(flat.T @ weighed, np.eye(COUNT), atol=1e-6)
    return flat, weighed


def test_modes_are_sorted_orthonormal_in_the_mass_and_without_rigid_motion() -> None:
    values, vectors = modes()
    flat, weighed = checked_columns(values, vectors)
    turns = np.cross(np.eye(3)[:, None], solid().mesh.nodes - solid().mesh.nodes.mean(axis=0)).reshape(3, -1)
    rigid = np.concatenate([np.tile(np.eye(3), len(solid().mesh.nodes)), turns])
    assert np.abs(rigid @ weighed).max() < 1e-6
    energy = np.einsum("ik,ik->k", flat, assemble_stiffness(solid(), Material()) @ flat) / solid().mass.sum()
    assert_allclose(energy, values, rtol=1e-6)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_scaled_modes_move_the_solid_by_the_motion(power: float) -> None:
    values, vectors = modes()
    scaled = scale_modes(values, vectors, 0.3, power)
    share = solid().mass / solid().mass.sum()
    assert np.einsum("n,nik,nik->", share, scaled, scaled) == pytest.approx(0.09, rel=1e-6)
    size = np.sqrt(np.einsum("n,nik,nik->k", share, scaled, scaled))
    assert_allclose(size / size[0], (values / values[0]) ** (-power / 2), rtol=1e-6)


def test_units_and_youngs_modulus_change_nothing() -> None:
    reference = covariance()
    size = np.abs(reference).max()
    assert_allclose(covariance(scale=1000.0) / 1e6, reference, atol=1e-6 * size)
    assert_allclose(covariance(young=3500.0), reference, atol=1e-6 * size)
    assert_allclose(modes(young=3500.0)[0], 3500 * modes()[0], rtol=1e-8)


def test_no_coefficients_are_the_rest_and_small_ones_are_linear() -> None:
    scaled = scale_modes(*modes(), motion=1e-4)
    state = StateMap(solid(), scaled)
    assert_allclose(state(np.zeros(COUNT)).nodes, solid().mesh.nodes, atol=1e-7)
    coefficients = default_rng(0).normal(size=COUNT)
    assert_allclose(state(coefficients).nodes, solid().mesh.nodes + scaled @ coefficients, atol=1e-6)


def test_drawn_states_keep_their_volume_and_centre() -> None:
    body = solid()
    scaled = scale_modes(*modes(), motion=0.1 * 2.5)
    state = StateMap(body, scaled)
    share = body.volumes / body.volumes.sum()
    changes = []
    for seed in range(40):
        coefficients = default_rng(seed).normal(size=COUNT)
        drawn = state(coefficients).nodes
        linear = body.mesh.nodes + scaled @ coefficients
        ratios = body.mesh.volume_ratios(drawn)
        assert ratios.min() > 0.3
        changes.append([share @ ratios - 1, share @ body.mesh.volume_ratios(linear) - 1])
        assert_allclose(body.mass @ (drawn - body.mesh.nodes), 0, atol=1e-9)
    kept, grown = np.abs(changes).T
    assert kept.max() < 0.03 and np.median(kept) < 0.01
    assert np.median(grown) > 3 * np.median(kept) and grown.max() > 0.1


def test_no_drawn_state_folds_or_swells_however_large_the_motion() -> None:
    """At a motion at which most of the prior's states turn tetrahedra inside out, and their volume by a tenth."""
    sampler = ElasticSampler(solid(), Material(), COUNT, 0.5 * 2.5)
    state = StateMap(solid(), sampler.modes)
    share = solid().volumes / solid().volumes.sum()
    calmed = 0
    for seed in range(12):
        drawn = sampler(default_rng(seed), no_surface)
        ratios = solid().mesh.volume_ratios(drawn.nodes)
        assert ratios.min() >= LEAST_RATIO and abs(share @ ratios - 1) <= MOST_SWELLING
        again = pickle.loads(pickle.dumps(sampler))(default_rng(seed), no_surface)  # as another process draws
        assert np.array_equal(drawn.nodes, again.nodes)
        wild = state(default_rng(seed).normal(size=COUNT)).nodes
        calmed += not np.allclose(wild, drawn.nodes)
    assert calmed > 6


def no_surface() -> tuple[ndarray, ndarray]:
    return np.empty((0, 3)), np.empty((0, 3))


def test_a_stiffer_part_bends_less() -> None:
    bar = SegmentedMesh((box((0, 0, 0), (3, 1, 1), "left", 0), box((3, 0, 0), (6, 1, 1), "right", 1)))
    even, uneven = (build_lattice(bar, 12, stiffness) for stiffness in ((1.0, 1.0), (1.0, 50.0)))

    def energies(body: ElasticSolid) -> ndarray:
        """Strain energy of each half in the softest modes, under the same stiffness."""
        _, vectors = find_modes(body, 4, Material())
        center = body.mesh.nodes[body.mesh.elements].mean(axis=1)[:, 0]
        flat = vectors.reshape(-1, 4)
        sides = (np.where(side, 1.0, 1e-9) for side in (center < 3, center > 3))
        halves = (assemble_stiffness(ElasticSolid(body.mesh, body.filled, side), Material()) for side in sides)
        return np.array([np.einsum("ik,ik->", flat, stiffness @ flat) for stiffness in halves])

    soft, stiff = energies(even), energies(uneven)
    assert soft[0] == pytest.approx(soft[1], rel=0.2)
    assert stiff[1] < 0.05 * stiff[0]
    stretched = np.zeros_like(uneven.mesh.nodes)
    stretched[:, 0] = 0.01 * uneven.mesh.nodes[:, 0]
    ratio = [stretched.ravel() @ (assemble_stiffness(body, Material()) @ stretched.ravel()) for body in (uneven, even)]
    assert ratio[0] / ratio[1] == pytest.approx((1 + 50) / 2, rel=0.05)


def test_what_is_held_does_not_move_and_nothing_is_rigid() -> None:
    held = solid().mesh.nodes[:, 0] < 1.0
    values, vectors = find_modes(solid(), COUNT, Material(), held)
    assert (vectors[held] == 0).all() and (np.abs(vectors[~held]).max(axis=(1, 2)) > 0).all()
    checked_columns(values, vectors)
    free = find_modes(solid(), COUNT, Material())[0]
    assert values[0] < free[0], "a cantilever is softer than a free bar"
    hinge = np.isclose(solid().mesh.nodes[:, [0, 2]], solid().mesh.nodes[0, [0, 2]]).all(axis=1)
    with pytest.raises(ValueError, match="what is held leaves it free to turn: hold more of it"):
        find_modes(solid(), COUNT, Material(), hinge)


def test_bad_materials_lattices_and_modes_are_refused() -> None:
    for value in (0.5, -1.0, nan):
        with pytest.raises(ValueError, match="must lie between -1 and 0.5: take 0.4 for tissue"):
            Material(value)
    with pytest.raises(ValueError, match="a lattice of 1 cells cannot bend; 2 or more are needed: take 16"):
        build_lattice(block(), 1)
    (part,) = block().segments
    with pytest.raises(ValueError, match="has no inside: turn its faces outward"):
        build_lattice(SegmentedMesh((replace(part, faces=part.faces[:, ::-1].copy()),)), 8)
    for share in (0.0, 1.5, nan):
        with pytest.raises(ValueError, match="must be above 0 and at most 1: leave empty ones out"):
            ElasticSolid(lattice(), np.full(len(lattice().elements), share))
    small = build_lattice(block(), 2)
    most = 3 * len(small.mesh.nodes) - 7
    for count in (0, most + 1):
        with pytest.raises(ValueError, match=f"{count} modes of .* nodes; from 1 to {most} exist: take more cells"):
            find_modes(small, count, Material())
    for value in (0.0, np.inf, nan):
        with pytest.raises(ValueError, match="must be above 0: take 1, which changes no mode"):
            Material(young=value)
        with pytest.raises(ValueError, match="it must be above 0: a tenth of half the longest side is moderate"):
            scale_modes(*modes(), motion=value)


def test_a_solid_in_pieces_is_refused() -> None:
    assert solid().pieces == 1
    pieces = SegmentedMesh((box((0, 0, 0), (2, 2, 2), "left", 0), box((6, 0, 0), (8, 2, 2), "right", 1)))
    assert build_lattice(pieces, 12).pieces == 2
    with pytest.raises(ValueError, match="it is not in one piece, or parts of it meet in an edge alone"):
        find_modes(build_lattice(pieces, 12), COUNT, Material())
