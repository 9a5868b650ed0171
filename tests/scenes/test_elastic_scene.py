"""Elastic solids in scene files: what the block says, the object's model made of it, and fits of that to frames."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fit_cases import IN_FRONT, seen
from numpy import ndarray
from numpy.testing import assert_allclose, assert_array_equal
from scene_files import HEAD, write_bar, write_mesh
from scipy.spatial.transform import Rotation
from shapes import box

from mereo.deformation.elastic import build_lattice
from mereo.deformation.tetrahedral import Tetrahedra
from mereo.fitting.config import ELASTIC
from mereo.fitting.problem.evidence import Directions, Evidence, signed
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import GivenPose, Problem
from mereo.fitting.problem.residuals import Prior, SampledSurface
from mereo.fitting.registration.answer_frame import initial_states, search_modes
from mereo.fitting.registration.register import CloudToFit
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.files.build import files_of
from mereo.scenes.random_states import model_key, scene_model, state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel, load_statistical_model, save_statistical_model

ELASTIC_BAR = """\
deformations:
  - type: elastic
    motion: 0.1
    cells: 10
    modes: 12
"""

HELD = """\
    held:
      - center: [105, 5, 5]
        direction: [-1, 0, 0]
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(str(write_bar(tmp_path_factory.mktemp("bar"), ELASTIC_BAR)))


@pytest.fixture(scope="module")
def model(scene: Scene) -> StatisticalModel:
    return scene_model(scene, 100)


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, StatisticalModel]:
    scene = load_scene(str(write_bar(tmp_path_factory.mktemp("held"), ELASTIC_BAR + HELD)))
    return scene, scene_model(scene, 100)


def off(model: StatisticalModel, found: ndarray, true: ndarray) -> float:
    """Root mean square distance of material points, in half lengths."""
    return float(np.sqrt(((found - true) ** 2).sum(axis=1).mean()) / model.half)


# --- the block --------------------------------------------------------------------------------------------------------


def test_states_move_as_much_as_the_block_says_and_keep_segments_in_contact(scene: Scene) -> None:
    half = np.ptp(scene.rest.bounds, axis=0).max() / 2
    moved = []
    rest = scene.rest.segments
    shared = [np.isclose(part.vertices[:, 0], rest[0].vertices[:, 0].max()) for part in rest]
    for index in range(12):
        mesh = scene.sample_state(example_rng(0, index)).mesh
        left, right = (part.vertices[rows] for part, rows in zip(mesh.segments, shared, strict=True))
        assert np.abs(left[np.lexsort(left.T)] - right[np.lexsort(right.T)]).max() < 1e-9
        moved.append(np.sqrt(((mesh.merged()[0] - scene.rest.merged()[0]) ** 2).sum(axis=1).mean()))
        volume = sum(part.volume for part in mesh.segments) / sum(part.volume for part in rest)
        assert volume == pytest.approx(1.0, abs=0.03)
    assert 0.05 < np.mean(moved) / half < 0.2


def test_one_word_says_the_deformations(tmp_path: Path) -> None:
    rigid_bar = load_scene(str(write_bar(tmp_path, "deformations: rigid\n")))
    assert np.array_equal(rigid_bar.sample_state(example_rng(0, 0)).mesh.merged()[0], rigid_bar.rest.merged()[0])
    texts = ("", "deformations: soft\n", "deformations: stiff\n")
    silent, soft, stiff = (load_scene(write_bar(tmp_path, text)).sample_deformations.steps[0][0] for text in texts)
    assert silent.motion == soft.motion == pytest.approx(4 * stiff.motion)
    with pytest.raises(ValueError, match="'wobbly' is no way to deform; it must be rigid, soft, stiff, or a list"):
        load_scene(str(write_bar(tmp_path, "deformations: wobbly\n")))


@pytest.mark.parametrize(
    ("tail", "message"),
    [
        (ELASTIC_BAR + "    stiffness: {lefd: 2}\n", "no segment is called 'lefd'"),
        (ELASTIC_BAR + "    held: [{center: [0, 0, 0], radius: 5}]\n", r"holds 0 of \d+ nodes .* it gets 3 where"),
        (ELASTIC_BAR + "    held: [{center: [0, 0, 0]}]\n", "either a radius .* or a direction .*: give one"),
        (ELASTIC_BAR + "    held: [{nodes: [0], radius: 5}]\n", "or else `points` or `nodes` alone: give one"),
        (ELASTIC_BAR + "    held: [{nodes: [0, 1, 2]}]\n", "a lattice has no nodes with numbers: name the file"),
        (ELASTIC_BAR + "    held: [{points: fixed.csv}]\n", "fixed.csv does not exist"),
        (ELASTIC_BAR.replace("0.1", "0.9"), "motion"),
        (ELASTIC_BAR + "    tetrahedra: bar.vtu\n", "both cells and tetrahedra; .*: drop one"),
        (ELASTIC_BAR.replace("cells: 10", "tetrahedra: bar.vtu"), "bar.vtu does not exist"),
        (ELASTIC_BAR.replace("cells: 10", "tetrahedra: bar.stl"), "suffix '.stl'; a volume mesh is one of"),
    ],
)
def test_blocks_that_do_not_fit_are_refused_with_their_line(tmp_path: Path, tail: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        load_scene(str(write_bar(tmp_path, tail)))
    assert "bar.yaml" in str(raised.value)


def test_segments_that_do_not_touch_are_no_solid(tmp_path: Path) -> None:
    alone = ELASTIC_BAR.replace("cells: 10", "cells: 10\n    segments: [left]")
    assert load_scene(str(write_bar(tmp_path, alone))), "a block of its own for each piece"
    path = write_bar(tmp_path, ELASTIC_BAR, HEAD.replace("right.stl", "far.stl"))
    write_mesh(box((160, 0, 0), (180, 10, 10)), tmp_path / "far.stl")
    message = "2 pieces that do not touch; an elastic solid is one: give each piece a block"
    with pytest.raises(ValueError, match=message):
        load_scene(str(path))


def write_volume(folder: Path, nodes: ndarray, elements: ndarray) -> str:
    """Block of an elastic solid of these tetrahedra, which are written into ``folder``."""
    np.savez(folder / "bar.npz", rest_nodes=nodes, tetrahedra=elements)
    return ELASTIC_BAR.replace("cells: 10", "tetrahedra: bar.npz")


@pytest.fixture(scope="module")
def volume() -> Tetrahedra:
    """Tetrahedra that fill the bar exactly, in its own unit."""
    lattice = build_lattice(SegmentedMesh((box((100, 0, 0), (140, 10, 10)),)), 16).mesh
    low = lattice.nodes.min(axis=0)
    size = np.ptp(lattice.nodes, axis=0)
    return Tetrahedra([100, 0, 0] + (lattice.nodes - low) / size * [40, 10, 10], lattice.elements)


def test_a_volume_mesh_takes_the_place_of_the_lattice(tmp_path: Path, volume: Tetrahedra) -> None:
    path = write_bar(tmp_path, write_volume(tmp_path, np.vstack([np.zeros(3), volume.nodes]), volume.elements + 1))
    scene = load_scene(path)
    solid = scene.sample_deformations.steps[0][0].solid
    assert_allclose(solid.mesh.nodes, transform_points(scene.T_scene_source, volume.nodes), atol=1e-9)
    assert solid.volumes.sum() == pytest.approx(np.ptp(scene.rest.bounds, axis=0).prod()), "all of it is filled"
    assert path.parent / "bar.npz" in files_of(path), "a copy of the object needs it"

    path.write_text(path.read_text() + "    stiffness: {right: 100}\n")
    stiff = load_scene(str(path)).sample_deformations.steps[0][0].solid
    right = stiff.mesh.nodes[stiff.mesh.elements].mean(axis=1)[:, 0] > scene.rest.bounds[:, 0].mean()
    assert_array_equal(stiff.stiffness, np.where(right, 100, 1))

    np.savez(tmp_path / "bar.npz", rest_nodes=volume.nodes * [1, 1, 1.01], tetrahedra=volume.elements)
    assert load_scene(str(path)).definition != scene.definition, "other tetrahedra are another object"


def test_nodes_are_held_by_their_numbers_or_by_points_near_them(tmp_path: Path, volume: Tetrahedra) -> None:
    block = write_volume(tmp_path, np.vstack([np.zeros(3), volume.nodes]), volume.elements + 1)  # node 0 is unused
    at_end = volume.nodes[:, 0] > 139
    np.savetxt(tmp_path / "fixed.csv", volume.nodes[at_end] + 0.01, delimiter=",")
    numbers = (np.flatnonzero(at_end) + 1).tolist()
    for held in (f"nodes: {numbers}", "points: fixed.csv", "center: [139, 0, 0], direction: [1, 0, 0]"):
        path = write_bar(tmp_path, block + f"    held: [{{{held}}}]\n")
        assert_array_equal(load_scene(path).sample_deformations.steps[0][0].held, at_end)
        assert (tmp_path / "fixed.csv" in files_of(path)) == (held == "points: fixed.csv")
    for held, message in (
        ("nodes: [0, 1, 2, 3]", "no tetrahedron has the node 0; they are 1 to"),
        ("nodes: [1, 2]", r"the list of nodes holds 2 of \d+ nodes of the solid; it must hold 3 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            load_scene(write_bar(tmp_path, block + f"    held: [{{{held}}}]\n"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda nodes, cells: (nodes / 1000, cells), "lies .* outside of the tetrahedra .*: check the unit"),
        (lambda nodes, cells: (nodes, cells + 1), "refers to node"),
        (lambda nodes, cells: (nodes, cells[:0]), "has no tetrahedra"),
        (lambda nodes, cells: (np.tile(nodes, (2, 1)), np.vstack([cells, cells + len(nodes)])), "2 pieces that share"),
    ],
)
def test_a_volume_mesh_that_does_not_fit_is_refused_with_its_line(
    tmp_path: Path,
    volume: Tetrahedra,
    change: Callable[[ndarray, ndarray], tuple[ndarray, ndarray]],
    message: str,
) -> None:
    block = write_volume(tmp_path, *change(volume.nodes, volume.elements))
    with pytest.raises(ValueError, match=message) as raised:
        load_scene(str(write_bar(tmp_path, block)))
    assert "bar.yaml:12: " in str(raised.value)


# --- the model --------------------------------------------------------------------------------------------------------


def test_the_model_has_the_modes_of_the_solid(scene: Scene, model: StatisticalModel, tmp_path: Path) -> None:
    assert model.is_normal and not model.is_held and model.count == 12 and len(model.pairs) == 0
    assert_array_equal(model.mean, model.rest_points)
    assert np.abs(model.library.std(axis=0) - 1).max() < 0.35
    state = scene.sample_state(example_rng(5, 0))
    points = state_points(state, model.nodes, model.node_labels)
    T, z = model.project(points)
    assert off(model, transform_points(T, model.material(z)), points) < 3 * model.residue_at(z) / model.half
    assert model.residue_at(0 * z) == 0 < model.residue < 0.02 * model.half
    prior = Prior.near(model, z)
    assert_array_equal(prior.precision, np.eye(12))
    save_statistical_model(model, tmp_path / "m.safetensors")
    again = load_statistical_model(tmp_path / "m.safetensors")
    assert again.is_normal and not again.is_held


def test_the_kept_model_is_another_for_another_solid(tmp_path: Path, scene: Scene) -> None:
    changes = (("motion: 0.1", "motion: 0.11"), ("cells: 10", "cells: 9"), ("modes: 12", "poisson: 0.3"))
    blocks = [ELASTIC_BAR, ELASTIC_BAR + HELD, *(ELASTIC_BAR.replace(old, new) for old, new in changes)]
    keys = [model_key(load_scene(str(write_bar(tmp_path, block))), 100) for block in blocks]
    assert len(set(keys)) == 5 and keys[0] == model_key(scene, 100)


# --- fits -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [5, 0])
def test_a_search_finds_a_state_of_the_solid(scene: Scene, model: StatisticalModel, index: int) -> None:
    state = scene.sample_state(example_rng(7, index))
    true = transform_points(IN_FRONT, state_points(state, model.nodes, model.node_labels))
    fitted = search_modes(CloudToFit(seen(state.mesh.transformed(IN_FRONT)), 1.0), model, ELASTIC)
    distance = fitted.surface.nearest(fitted.problem.evidence.observed_samples)[0]
    assert np.quantile(distance, 0.9) < 0.3
    found = fitted.surface.material
    turned = transform_points(IN_FRONT, model.mean)
    assert min(off(model, found, true), 1.0) < 0.6 * off(model, turned, true) or fitted.others


def test_a_given_pose_starts_the_fit_and_holds_what_is_held(held: tuple[Scene, StatisticalModel]) -> None:
    scene, model = held
    assert model.is_held
    state = scene.sample_state(example_rng(3, 1))
    true = state_points(state, model.nodes, model.node_labels)
    base = model.rest_points[:, 0] < np.quantile(model.rest_points[:, 0], 0.12)
    shift = true[base].mean(axis=0) - model.rest_points[base].mean(axis=0)
    world = rigid(np.eye(3), -shift)  # the drawn state keeps its centre of mass, a held one its base
    T = IN_FRONT @ world
    cloud = seen(state.mesh.transformed(T))
    true = transform_points(T, true)
    T_files = rigid(IN_FRONT[:3, :3], transform_points(IN_FRONT, scene.source_frame.T_scene_source[:3, 3]))
    (start,) = initial_states(T_files, model, 1.0)
    assert_allclose(start.place(model.mean), transform_points(IN_FRONT, model.mean), atol=1e-6)
    wrong = Posed(Rotation.from_rotvec([0.0, 0.0, 0.02]).as_matrix() @ start.rotation, start.translation, start.z)
    fitted = search_modes(CloudToFit(cloud, 1.0), model, ELASTIC, [wrong])
    assert fitted.problem.given is not None
    assert off(model, fitted.surface.material, true) < 0.5 * off(model, transform_points(IN_FRONT, model.mean), true)


def test_a_given_pose_weighs_as_its_error_says(held: tuple[Scene, StatisticalModel]) -> None:
    _, model = held
    start = Posed(np.eye(3), np.array([0.0, 0.0, 120.0]), np.zeros(model.count))
    evidence = Evidence.of(seen(model.rest.transformed(rigid(np.eye(3), start.translation))))
    problem = Problem(model, evidence, 1e-6, ELASTIC, given=GivenPose(start, 0.5))
    moved = Posed(np.eye(3), np.array([0.3, 0.0, 120.0]), np.zeros(model.count))
    prior = Prior.whole(model)
    gradient = problem.known(moved, prior, 0.0).gradient
    assert gradient[3] == pytest.approx(0.3 / 0.5**2, rel=1e-9), "of (0.3 / 0.5)^2 / 2"
    step = problem.known(moved, prior, 0.0).step(0.0)
    assert_allclose(moved.moved(step).translation, start.translation, atol=1e-3)


def test_pairs_by_direction_tell_the_sides_of_a_thin_part_apart(model: StatisticalModel) -> None:
    samples = SampledSurface.of(model, 2000).posed(Posed(np.eye(3), np.array([0.0, 0.0, 120.0]), np.zeros(model.count)))
    points = samples.position.astype(float)
    top = samples.normal[:, 2] < -0.9
    across = np.ptp(points[:, 2])
    normals = samples.normal[top].astype(float)
    beneath = points[top] + np.array([0.0, 0.0, 0.8 * across])
    # of all samples and not of facing ones alone, the nearest are those of the other side
    _, by_place, _ = samples.planes(beneath, Directions(signed, normals, 0.0))
    _, by_direction, _ = samples.planes(beneath, Directions(signed, normals, 2.0 * across))
    assert (np.einsum("pi,pi->p", by_place, normals) < 0).mean() > 0.3
    assert (np.einsum("pi,pi->p", by_direction, normals) > 0.9).all()
