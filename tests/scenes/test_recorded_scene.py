"""Scene files whose deformations are recorded states: in the meshes' own frame and unit, split, and identified."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from lattice import pvd_text
from scene_files import write_bar

from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.simulation_states import files_of_states
from mereo.scenes.registry import files_of, load_scene
from mereo.scenes.seeds import TEST_SEED_START

FRAMES = 10


def frame(vertices: np.ndarray, number: int) -> np.ndarray:
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
    rng, found = np.random.default_rng(0), set()
    scale, center = 2.0, np.array([120, 5, 5])  # the shortest side, 10 mm, becomes 20 units
    files = [read_segmented_mesh(path.parent / f"{name}.stl").segments[0].vertices for name in ("left", "right")]
    for _ in range(60):
        mesh = scene.sample_state(rng).mesh
        number = round((mesh.segments[0].bounds[1, 1] / scale + center[1] - 10) / 0.3)
        for segment, vertices in zip(mesh.segments, files, strict=True):
            np.testing.assert_allclose(segment.vertices, (frame(vertices, number) - center) * scale, atol=1e-4)
        found.add(number)
    return found


def test_states_are_the_files_and_test_seeds_see_others(bar: Path) -> None:
    assert drawn(bar, 0) == set(range(7))
    assert drawn(bar, TEST_SEED_START) == {7, 8, 9}


def test_other_states_are_another_scene(bar: Path) -> None:
    before = load_scene(bar).definition
    assert load_scene(bar).definition == before
    write_states(bar.parent, frames=FRAMES + 1)
    assert load_scene(bar).definition != before


def test_missing_states_are_said_with_their_line(tmp_path: Path) -> None:
    path = write_bar(tmp_path, "states: motion.npz\n")
    with pytest.raises(ValueError, match=r"bar\.yaml:9: `states` is 'motion.npz', and .* does not exist: check"):
        load_scene(path)


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
    with pytest.raises(ValueError, match=r"bar\.yaml:9: `states` is 'rest.obj', and .* does not exist: check"):
        load_scene(numpy_bar)
    text = numpy_bar.read_text()
    for wrong, message in (
        ("{positions: run.npy, nodes: rest.obj}", "the key `nodes` means nothing here: known are mesh"),
        ("{mesh: rest.obj}", "`positions` is missing; it must be given"),
        ("[run.npy]", "`states` is .*; it must be a path, or a block of the keys positions and mesh: correct it"),
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


def test_states_and_deformations_exclude_each_other(tmp_path: Path) -> None:
    path = write_bar(tmp_path, "states: states.npz\ndeformations:\n  - {type: lattice}\n")
    with pytest.raises(ValueError, match="both states and deformations; recorded states say how the object moves"):
        load_scene(path)
