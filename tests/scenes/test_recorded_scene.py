"""Scene files whose deformations are recorded states: in the meshes' own frame and unit, split, and identified."""

from pathlib import Path

import numpy as np
import pytest
from scene_files import write_bar

from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.files.check import check_scene
from mereo.scenes.registry import load_scene
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


def test_the_scene_is_placed_and_checked_as_any_other(bar: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = load_scene(bar)
    assert scene.unit_m == pytest.approx(0.0005) and scene.rest.names == ("left", "right")
    check_scene(str(bar), repair=False)
    assert "fault" not in capsys.readouterr().out


def test_other_states_are_another_scene(bar: Path) -> None:
    before = load_scene(bar).definition
    assert load_scene(bar).definition == before
    write_states(bar.parent, frames=FRAMES + 1)
    assert load_scene(bar).definition != before


def test_missing_states_are_said_with_their_line(tmp_path: Path) -> None:
    path = write_bar(tmp_path, "states: motion.npz\n")
    with pytest.raises(ValueError, match=r"bar\.yaml:9: `states` is 'motion.npz', and .* does not exist: check"):
        load_scene(path)


def test_states_and_deformations_exclude_each_other(tmp_path: Path) -> None:
    path = write_bar(tmp_path, "states: states.npz\ndeformations:\n  - {type: lattice}\n")
    with pytest.raises(ValueError, match="both states and deformations; recorded states say how the object moves"):
        load_scene(path)
