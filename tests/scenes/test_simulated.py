"""Simulated states: recorded frames are met exactly, never shared by training and testing, and named in scene files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import untrained
from lattice import SIZE, boxes, lattice, pvd_text, states
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose
from scene_files import write_bar
from shapes import ball
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.deformation.maps import invert, jacobian_determinant
from mereo.deformation.tetrahedral import Surface, SurfaceMap, Tetrahedra, TetrahedralMap
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.simulation_states import files_of_states
from mereo.scenes.registry import files_of, load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo_learning import shards
from mereo_learning.scoring import EvaluationConfig, evaluate

# --- tetrahedra -------------------------------------------------------------------------------------------------------


def test_an_affine_motion_of_the_nodes_is_one_of_all_space() -> None:
    matrix, shift = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.3, 1.0]]), np.array([1.0, -2.0, 3.0])
    mesh = lattice()
    deformation = TetrahedralMap(mesh, mesh.nodes @ matrix.T + shift)
    points = default_rng(0).uniform(-2, 7, size=(400, 3))  # most of them outside
    assert np.allclose(deformation(points), points @ matrix.T + shift, atol=1e-12)


def test_nodes_go_where_the_state_has_them_and_the_map_is_continuous_at_the_surface() -> None:
    mesh = lattice()
    nodes = states()[-1]
    deformation = TetrahedralMap(mesh, nodes)
    assert np.allclose(deformation(mesh.nodes), nodes, atol=1e-12)
    face = mesh.nodes[mesh.surface].mean(axis=1)
    step = 1e-7 * (face - np.array(SIZE) / 2)
    assert np.abs(deformation(face + step) - deformation(face - step)).max() < 1e-5


def test_tetrahedra_have_the_jacobian_of_their_volumes() -> None:
    mesh = lattice()
    nodes = states()[0]
    centers = mesh.nodes[mesh.elements].mean(axis=1)
    determinant = jacobian_determinant(TetrahedralMap(mesh, nodes), centers)
    assert np.allclose(determinant, mesh.volume_ratios(nodes), atol=1e-5)
    assert (mesh.volumes > 0).any() and (mesh.volumes < 0).any()  # either orientation is taken


def test_inverse_is_exact_inside_and_found_outside() -> None:
    deformation = TetrahedralMap(lattice(), states()[-1])
    inner = default_rng(1).uniform(0.0, SIZE, size=(500, 3))
    points = np.concatenate([inner, inner * [1, 1, 0] + [0, 0, -0.1]])
    # a useless guess: where the point lies inside a tetrahedron none is needed
    guess = np.concatenate([np.full((500, 3), 40.0), points[500:] + 0.05])
    found, converged = invert(deformation, deformation(points), guess)
    assert converged.all()
    assert np.abs(found - points)[:500].max() < 1e-12 and np.abs(found - points).max() < 1e-5


def test_bad_tetrahedra_are_named() -> None:
    nodes = np.eye(4, 3)
    elements = np.array([[0, 1, 2, 3]])
    for bad, of_them, message in (
        (nodes, np.array([[0, 1, 2, 3], [0, 1, 2, 2]]), "tetrahedron 1 has no volume at rest; it must have some"),
        (nodes, elements + 1, "refers to node 4, but there are 4; indices run from 0: subtract 1"),
        (np.where(np.arange(4)[:, None] == 2, np.nan, nodes), elements, "rest node 2 is not finite"),
    ):
        with pytest.raises(ValueError, match=message):
            Tetrahedra(bad, of_them)


# --- surfaces ---------------------------------------------------------------------------------------------------------


def test_a_surface_alone_is_met_exactly_and_affine_motions_throughout() -> None:
    part = ball((1, 2, 3), 4.0, level=3)
    moved = part.vertices + 0.5 * np.sin(part.vertices[:, [1, 2, 0]])
    assert np.abs(SurfaceMap(Surface(part.vertices, part.faces), moved)(part.vertices) - moved).max() < 1e-9
    matrix = np.array([[0.0, -1.1, 0.0], [0.9, 0.0, 0.2], [0.0, 0.0, 1.0]])
    points = default_rng(0).uniform([-1, 0, 1], [3, 4, 5], size=(200, 3))
    affine = SurfaceMap(Surface(part.vertices, part.faces), part.vertices @ matrix.T + 5)
    assert np.abs(affine(points) - points @ matrix.T - 5).max() < 1e-8


def test_the_interior_estimate_is_near_the_solid_that_made_the_surface() -> None:
    part = boxes().segments[0]
    rng = default_rng(2)
    points = rng.uniform(*part.bounds, size=(400, 3))
    surface = Surface(part.vertices, part.faces)
    for nodes in states()[[0, -1]]:
        truth = TetrahedralMap(lattice(), nodes)
        estimate = SurfaceMap(surface, truth(part.vertices))
        error = norm(estimate(points) - truth(points), axis=1)
        assert np.sqrt((error**2).mean()) < 0.1 * np.sqrt(((truth(points) - points) ** 2).sum(axis=1).mean())
        assert jacobian_determinant(estimate, points).min() > 0.3
        found, converged = invert(estimate, estimate(points), points + 0.05)
        assert converged.mean() > 0.99 and np.abs(found - points)[converged].max() < 1e-4


# --- training and testing ---------------------------------------------------------------------------------------------


def test_only_test_seeds_take_held_out_states_which_are_of_the_same_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "rest_distances", lambda rest: np.zeros((4, 2, 2, 2), np.float16))  # slow

    def forbidden(rng: Generator) -> tuple:
        raise AssertionError("drawn from the wrong states")

    toy = toy_scene()
    blocked = replace(toy, sample_deformations=forbidden)
    settings = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))
    only_test, only_training = replace(blocked, held_out=toy), replace(toy, held_out=blocked)
    generate(only_test, tmp_path / "test", settings, examples=2, seed=TEST_SEED_START, test=True)
    generate(only_training, tmp_path / "train", settings, examples=2, seed=0)
    assert len(evaluate(untrained(toy.rest.names), EvaluationConfig(only_test, 1, cells=8)).examples) == 1
    for scene, seed in ((only_test, 0), (only_training, TEST_SEED_START)):
        with pytest.raises(AssertionError, match="wrong states"):
            generate(scene, tmp_path / f"{seed}", settings, examples=1, seed=seed, test=seed > 0)
    with pytest.raises(ValueError, match="held-out states left, right; they must be one object"):
        replace(toy, held_out=Scene("b", boxes(), toy.sample_deformations))


# --- scene files ------------------------------------------------------------------------------------------------------


FRAMES = 10


def frame(vertices: ndarray, number: int) -> ndarray:
    """Millimetres: the bar bows sideways, by more with every frame."""
    along = (vertices[:, 0] - 120) / 20
    return vertices + np.outer(1 - along**2, [0, 0.3 * number, 0])


def write_states(folder: Path, frames: int = FRAMES) -> None:
    states = {}
    for name in ("left", "right"):
        vertices = read_segmented_mesh(folder / f"{name}.stl").segments[0].vertices
        states[name] = np.stack([frame(vertices, number) for number in range(frames)])
        states[f"{name}.rest"] = vertices
    np.savez(folder / "states.npz", **states)


@pytest.fixture
def bar(tmp_path: Path) -> Path:
    path = write_bar(tmp_path, "states: states.npz\nheld_out: 0.3\n")
    write_states(tmp_path)
    return path


def drawn(path: Path, seed: int) -> set[int]:
    """The frames that a seed draws, told by the height of the bow, after checking each of them exactly."""
    scene = load_scene(path).for_seed(seed)
    rng = default_rng(0)
    found = set()
    scale = 2.0
    center = np.array([120, 5, 5])  # the shortest side, 10 mm, becomes 20 units
    files = [read_segmented_mesh(path.parent / f"{name}.stl").segments[0].vertices for name in ("left", "right")]
    for _ in range(60):
        mesh = scene.sample_state(rng).mesh
        number = round((mesh.segments[0].bounds[1, 1] / scale + center[1] - 10) / 0.3)
        for segment, vertices in zip(mesh.segments, files, strict=True):
            assert_allclose(segment.vertices, (frame(vertices, number) - center) * scale, atol=1e-4)
        found.add(number)
    return found


def test_states_are_the_files_and_test_seeds_see_others(bar: Path) -> None:
    assert drawn(bar, 0) == set(range(7)) and drawn(bar, TEST_SEED_START) == {7, 8, 9}
    before = load_scene(bar).definition
    assert load_scene(bar).definition == before
    write_states(bar.parent, frames=FRAMES + 1)
    assert load_scene(bar).definition != before, "other states are another scene"


@pytest.fixture
def numpy_bar(tmp_path: Path) -> Path:
    """Positions of both segments' vertices in an array, and the mesh that they are of."""
    path = write_bar(tmp_path, "states: {positions: run.npy, mesh: rest.obj}\nheld_out: 0.3\n")
    vertices, faces = read_segmented_mesh(tmp_path / "left.stl", tmp_path / "right.stl").merged()[:2]
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "rest.obj")
    np.save(tmp_path / "run.npy", np.stack([frame(vertices, number) for number in range(FRAMES)]))
    return path


def test_positions_in_an_array_are_states_with_their_mesh(numpy_bar: Path) -> None:
    assert drawn(numpy_bar, 0) == set(range(7))
    before = load_scene(numpy_bar).definition
    rest = numpy_bar.with_name("rest.obj")
    rest.write_text(rest.read_text() + "# another file\n")
    assert load_scene(numpy_bar).definition != before
    assert {numpy_bar.with_name("run.npy"), rest} <= set(files_of(numpy_bar))


def test_a_mesh_of_states_that_is_missing_or_misspelt_is_said_with_its_line(numpy_bar: Path) -> None:
    numpy_bar.with_name("rest.obj").unlink()
    text = numpy_bar.read_text()
    for wrong, message in (
        ("{positions: run.npy, mesh: rest.obj}", r"bar\.yaml:9: `states` is 'rest.obj', and .* does not exist: check"),
        ("motion.npz", r"bar\.yaml:9: `states` is 'motion.npz', and .* does not exist: check"),
        ("{positions: run.npy, nodes: rest.obj}", "the key `nodes` means nothing here: known are mesh"),
        ("{mesh: rest.obj}", "`positions` is missing; it must be given"),
        ("[run.npy]", "`states` is .*; it must be a path, or a block of the keys positions and mesh: correct it"),
        ("s.npz\ndeformations: soft", "both states and deformations; recorded states say how the object moves"),
    ):
        numpy_bar.write_text(text.replace("{positions: run.npy, mesh: rest.obj}", wrong))
        with pytest.raises(ValueError, match=message):
            load_scene(numpy_bar)


def test_what_a_collection_names_is_read_and_kept(tmp_path: Path) -> None:
    path = write_bar(tmp_path, "states: run.pvd\n")
    (tmp_path / "a b").mkdir()
    names = ["a b/0.vtu", "1.vtu", "gone.vtu"]
    (tmp_path / "run.pvd").write_text(pvd_text(names))
    (tmp_path / "run.xdmf").write_text('<DataItem Format="HDF"> run.h5:/Mesh/0 </DataItem> 1.5 2.5')
    for name in (*names[:2], "run.h5"):
        (tmp_path / name).write_bytes(b"x")
    assert files_of(path)[-3:] == [tmp_path / name for name in ("run.pvd", *names[:2])]
    assert files_of_states(tmp_path / "run.xdmf") == [tmp_path / "run.xdmf", tmp_path / "run.h5"]
    assert files_of_states(tmp_path / "*.vtu") == [tmp_path / "1.vtu"]
