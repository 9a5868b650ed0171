"""Simulated states: recorded frames are met exactly, undone exactly, and never shared by training and testing."""

from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from lattice import SIZE, boxes, lattice, states
from shapes import ball
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.deformation.maps import invert, jacobian_determinant
from mereo.deformation.tetrahedral import Surface, SurfaceMap, Tetrahedra, TetrahedralMap
from mereo.evaluation.scoring import EvaluationConfig, evaluate
from mereo.io.simulation_states import TetrahedralRecord, read_states
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis import shards
from mereo.synthesis.config import GenerateConfig, SamplingConfig

SHIPPED = Path(__file__).parents[2] / "src/mereo/states/liver.npz"


def inner_points(count: int = 500, margin: float = 0.0) -> np.ndarray:
    return np.random.default_rng(1).uniform(margin, np.array(SIZE) - margin, size=(count, 3))


# --- tetrahedra -------------------------------------------------------------------------------------------------------


def test_an_affine_motion_of_the_nodes_is_one_of_all_space() -> None:
    matrix, shift = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.3, 1.0]]), np.array([1.0, -2.0, 3.0])
    mesh = lattice()
    deformation = TetrahedralMap(mesh, mesh.nodes @ matrix.T + shift)
    points = np.random.default_rng(0).uniform(-2, 7, size=(400, 3))  # most of them outside
    assert np.allclose(deformation(points), points @ matrix.T + shift, atol=1e-12)


def test_nodes_go_where_the_state_has_them_and_the_map_is_continuous_at_the_surface() -> None:
    mesh, nodes = lattice(), states()[-1]
    deformation = TetrahedralMap(mesh, nodes)
    assert np.allclose(deformation(mesh.nodes), nodes, atol=1e-12)
    face = mesh.nodes[mesh.surface].mean(axis=1)
    step = 1e-7 * (face - np.array(SIZE) / 2)
    assert np.abs(deformation(face + step) - deformation(face - step)).max() < 1e-5


def test_tetrahedra_have_the_jacobian_of_their_volumes() -> None:
    mesh, nodes = lattice(), states()[0]
    centers = mesh.nodes[mesh.elements].mean(axis=1)
    determinant = jacobian_determinant(TetrahedralMap(mesh, nodes), centers)
    assert np.allclose(determinant, mesh.volume_ratios(nodes), atol=1e-5)
    assert (mesh.volumes > 0).any() and (mesh.volumes < 0).any()  # either orientation is taken


def test_inverse_is_exact_inside_and_found_outside() -> None:
    deformation = TetrahedralMap(lattice(), states()[-1])
    points = np.concatenate([inner_points(), inner_points() * [1, 1, 0] + [0, 0, -0.1]])
    # a useless guess: where the point lies inside a tetrahedron none is needed
    guess = np.concatenate([np.full((500, 3), 40.0), points[500:] + 0.05])
    found, converged = invert(deformation, deformation(points), guess)
    assert converged.all()
    assert np.abs(found - points)[:500].max() < 1e-12 and np.abs(found - points).max() < 1e-5


def test_bad_tetrahedra_are_named() -> None:
    nodes, elements = np.eye(4, 3), np.array([[0, 1, 2, 3]])
    with pytest.raises(ValueError, match="tetrahedron 1 has no volume at rest; it must have some"):
        Tetrahedra(nodes, np.array([[0, 1, 2, 3], [0, 1, 2, 2]]))
    with pytest.raises(ValueError, match="refers to node 4, but there are 4; indices run from 0: subtract 1"):
        Tetrahedra(nodes, elements + 1)
    with pytest.raises(ValueError, match="rest node 2 is not finite"):
        Tetrahedra(np.where(np.arange(4)[:, None] == 2, np.nan, nodes), elements)


# --- surfaces ---------------------------------------------------------------------------------------------------------


def test_a_surface_alone_is_met_exactly_and_affine_motions_throughout() -> None:
    part = ball((1, 2, 3), 4.0, level=3)
    moved = part.vertices + 0.5 * np.sin(part.vertices[:, [1, 2, 0]])
    assert np.abs(SurfaceMap(Surface(part.vertices, part.faces), moved)(part.vertices) - moved).max() < 1e-9
    matrix = np.array([[0.0, -1.1, 0.0], [0.9, 0.0, 0.2], [0.0, 0.0, 1.0]])
    points = np.random.default_rng(0).uniform([-1, 0, 1], [3, 4, 5], size=(200, 3))
    affine = SurfaceMap(Surface(part.vertices, part.faces), part.vertices @ matrix.T + 5)
    assert np.abs(affine(points) - points @ matrix.T - 5).max() < 1e-8


def test_the_interior_estimate_is_near_the_solid_that_made_the_surface() -> None:
    part, rng = boxes().segments[0], np.random.default_rng(2)
    points = rng.uniform(*part.bounds, size=(400, 3))
    surface = Surface(part.vertices, part.faces)
    for nodes in states()[[0, -1]]:
        truth = TetrahedralMap(lattice(), nodes)
        estimate = SurfaceMap(surface, truth(part.vertices))
        error = np.linalg.norm(estimate(points) - truth(points), axis=1)
        assert np.sqrt((error**2).mean()) < 0.1 * np.sqrt(((truth(points) - points) ** 2).sum(axis=1).mean())
        assert jacobian_determinant(estimate, points).min() > 0.3
        found, converged = invert(estimate, estimate(points), points + 0.05)
        assert converged.mean() > 0.99 and np.abs(found - points)[converged].max() < 1e-4


# --- training and testing ---------------------------------------------------------------------------------------------


def test_generation_and_evaluation_take_held_out_states_for_test_seeds_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "rest_distances", lambda rest: np.zeros((4, 2, 2, 2), dtype=np.float16))  # slow

    def forbidden(rng: np.random.Generator) -> tuple:
        raise AssertionError("drawn from the wrong states")

    toy = toy_scene()
    blocked = Scene("toy", toy.rest, forbidden, toy.workspace)
    settings = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))
    only_test = Scene("toy", toy.rest, forbidden, toy.workspace, held_out=toy)
    only_training = Scene("toy", toy.rest, toy.sample_deformations, toy.workspace, held_out=blocked)
    generate(only_test, tmp_path / "test", settings, examples=2, seed=TEST_SEED_START, test=True)
    generate(only_training, tmp_path / "train", settings, examples=2, seed=0)
    assert len(evaluate(untrained(toy.rest.names), EvaluationConfig(only_test, 1, cells=8)).examples) == 1
    for scene, seed in ((only_test, 0), (only_training, TEST_SEED_START)):
        with pytest.raises(AssertionError, match="wrong states"):
            generate(scene, tmp_path / f"{seed}", settings, examples=1, seed=seed, test=seed > 0)


def test_held_out_states_are_of_the_same_object() -> None:
    toy = toy_scene()
    with pytest.raises(ValueError, match="held-out states left, right; they must be one object"):
        Scene("toy", toy.rest, toy.sample_deformations, held_out=Scene("b", boxes(), toy.sample_deformations))


def test_shipped_states_are_sane() -> None:
    record = read_states(SHIPPED, ("liver", "gallbladder"))
    assert isinstance(record, TetrahedralRecord) and len(record.displacements) >= 200
    assert SHIPPED.stat().st_size < 3_000_000
    mesh = Tetrahedra(record.rest_nodes, record.tetrahedra)
    largest = np.linalg.norm(record.displacements.astype(float), axis=2).max(axis=1)
    assert largest.min() > 5 and largest.max() < 40.1  # millimetres
    ratios = np.stack([mesh.volume_ratios(mesh.nodes + moved.astype(float)) for moved in record.displacements])
    assert ratios.min() > 0.3 and ratios.max() < 3
    assert len(np.unique(largest)) > 0.9 * len(largest)  # no state twice
