"""The sheet of all scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy_scene import toy_scene

from mereo.cli.scenes import ScenePreview
from mereo.scenes.scene import SCENES, Scene
from mereo.visualization import previews
from mereo.visualization.previews import TILE_PX, preview_all, scene_row


def toy(name: str) -> Scene:
    return replace(toy_scene(), name=name)


def colored(picture: np.ndarray) -> np.ndarray:
    return np.ptp(picture.astype(int), axis=-1) > 60


def test_every_scene_has_a_view() -> None:
    assert set(previews.SCENE_VIEWS) == set(SCENES)


def test_a_row_is_three_states_at_one_scale_their_overlay_and_a_depth_image() -> None:
    rest, first, second, laid, depth = scene_row(toy("robot"), seed=1)
    assert all(picture.shape == (TILE_PX, TILE_PX, 3) for picture in (rest, first, second, laid, depth))
    drawn = [(picture < 255).any(axis=-1) for picture in (rest, first, second)]
    assert np.array_equal((laid < 255).any(axis=-1), np.logical_or.reduce(drawn)), "what any shows, the overlay shows"
    only = drawn[1] & ~drawn[0] & ~drawn[2]
    assert only.any() and np.abs(laid[only] - (510.0 + first[only]) / 3).max() <= 0.5
    shown = [colored(picture) for picture in (rest, first, second)]
    assert all(700 < mask.sum() < 0.8 * TILE_PX**2 for mask in shown)
    margin = np.ones((TILE_PX, TILE_PX), dtype=bool)
    margin[2:-2, 2:-2] = False
    together = np.logical_or.reduce(shown)
    assert not (together & margin).any()  # nothing is cut off
    sides = [np.ptp(np.flatnonzero(together.any(axis=axis))) for axis in (0, 1)]
    assert max(sides) > 0.8 * TILE_PX  # and no room is wasted
    assert (rest != first).any() and (first != second).any()
    assert (np.abs(depth.astype(int) - 237).max(axis=-1) > 20).mean() > 0.02
    again = scene_row(toy("robot"), seed=1)
    assert all(np.array_equal(a, b) for a, b in zip(again, (rest, first, second, laid, depth), strict=True))


def test_the_sheet_has_a_row_of_five_for_every_scene(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    loaded: list[str] = []

    def load(name: str) -> Scene:
        loaded.append(name)
        return toy(name)

    monkeypatch.setattr(previews, "load_scene", load)
    monkeypatch.setattr(previews, "SCENES", ("robot", "sheet", "tumor"))
    preview_all(tmp_path / "all.png", seed=2)
    assert loaded == ["robot", "sheet", "tumor"]
    picture = np.asarray(Image.open(tmp_path / "all.png"))
    row = TILE_PX + 24 + 12
    assert picture.shape == (12 + 2 * row, 12 + 10 * (TILE_PX + 12), 3)
    cells = [picture[12 + r * row :, 12 + c * (TILE_PX + 12) :][:TILE_PX, :TILE_PX] for r in (0, 1) for c in range(10)]
    filled = [bool((cell < 250).any()) for cell in cells]
    assert filled == [True] * 15 + [False] * 5
    assert np.array_equal(cells[5], scene_row(toy("sheet"), 2)[0])


@pytest.mark.parametrize("scene, all_scenes, said", [("", False, "neither"), ("rope", True, "both 'rope' and --all")])
def test_one_scene_or_all(tmp_path: Path, scene: str, all_scenes: bool, said: str) -> None:
    with pytest.raises(ValueError, match=f"{said}.*name a scene, or give --all"):
        ScenePreview(tmp_path / "x.png", scene, all_scenes).run()
    assert not list(tmp_path.iterdir())
