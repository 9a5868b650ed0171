"""What lies on the stage of the viewer's pages: points as large as their spacing allows, names, colours in sight."""

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from browser import until
from test_view import toy_inspection
from toy_scene import toy_scene

from mereo.models.weights import load_model
from mereo.scenes.parameters import Parameter, random_state
from mereo.scenes.registry import load_scene
from mereo.visualization.units import Unit
from mereo.visualization.viewer.display import CLOUD_SIZES, POINT_SHARE, SegmentControls, point_size
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.lab_page import LabPage
from mereo.visualization.viewer.lab_stage import ASIDE, LabStage, Moment
from mereo.visualization.viewer.laboratory import Laboratory

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")


def grid(count: int, spacing: float) -> np.ndarray:
    axis = np.arange(count) * spacing
    return np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)


def test_points_take_a_share_of_their_spacing_within_bounds() -> None:
    low, high = CLOUD_SIZES
    assert point_size(grid(60, 0.02)) == pytest.approx(POINT_SHARE * 0.02)
    assert point_size(grid(60, 1e-4)) == low and point_size(grid(5, 0.5)) == high
    # a cloud's points more than once, one alone, all at one place
    assert point_size(np.repeat(grid(60, 0.02), 2, axis=0)) == high
    twice = np.concatenate([grid(60, 0.02), grid(60, 0.02)[:100]])
    assert point_size(twice) == pytest.approx(POINT_SHARE * 0.02)
    assert point_size(np.zeros((1, 3))) == high and point_size(np.zeros((9, 3))) == high


@needs_viser
def test_points_give_way_to_the_colours_of_a_frame(server: object) -> None:
    page = FramePage(server, toy_inspection(), "toy", "closed form", Unit(0.001))
    (cloud,) = (handle for name, handle in nodes(server).items() if name == "/cloud")
    assert cloud.visible
    page.coloring.value = "distance"
    assert not cloud.visible
    page.coloring.value = "segment"
    assert cloud.visible


def nodes(server: object) -> dict:
    return server.scene._handle_from_node_name  # type: ignore[attr-defined]


@needs_viser
def test_side_by_side_both_are_named_under_themselves(server: object) -> None:
    laboratory = Laboratory(load_scene("rope"), replace(load_model("rope"), statistical_model=None))
    view = laboratory.look(random_state(laboratory.scene, 3), laboratory.first_place())
    moment = Moment(view, laboratory.rebuild(view, 16, 8))
    stage = LabStage(server, laboratory)
    controls = SegmentControls(server.gui, laboratory.scene.rest, lambda: None)  # type: ignore[attr-defined]
    scale = stage.draw(moment, "side by side", "error", controls, points=False)
    assert scale is not None and "true surface" in scale.title and not nodes(server)["/points"].visible
    right, down = view.T_world_camera[:3, 0], view.T_world_camera[:3, 1]
    found, true = (np.array(nodes(server)[f"/names/{name}"].position) for name in ("reconstruction", "truth"))
    assert (true - found) @ right == pytest.approx(2 * ASIDE, abs=0.3)
    shown = np.concatenate([s.vertices for s in view.mesh.segments]) @ view.T_world_camera[:3, :3].T
    lowest = (stage.stage.place(shown + view.T_world_camera[:3, 3]) @ down).max()
    assert lowest < true @ down < lowest + 0.5
    assert stage.draw(moment, "truth", "segment", controls, points=True) is None
    assert nodes(server)["/points"].visible and not any(name.startswith("/names/") for name in nodes(server))


@needs_viser
def test_undo_takes_back_what_one_hand_did(server: object) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None), "toy", "no weights")
    try:
        until(lambda: page.moment is not None)
        wishes, freedom = page.wishes, page.laboratory.freedom
        first = wishes.shape
        assert page._undo.disabled
        one, other = freedom.parameters(first)[:2]

        def change(ask: Callable[[], None]) -> None:
            before = page.moment
            page.wish(ask)
            until(lambda: page.moment is not before)

        def value(of: Parameter) -> float:
            return next(p.value for p in freedom.parameters(wishes.shape) if p.key == of.key and p.index == of.index)

        middle, end = (one.low + one.high) / 2, 0.9 * one.high + 0.1 * one.low
        change(lambda: wishes.move(one, middle))
        change(lambda: wishes.move(one, end))  # the same slider, still being dragged
        change(lambda: wishes.move(other, (other.low + other.high) / 2))
        change(wishes.anew)
        assert not page._undo.disabled
        change(wishes.back)
        assert value(one) == pytest.approx(end)
        change(wishes.back)
        assert value(one) == pytest.approx(end) and value(other) == pytest.approx(other.value)
        change(wishes.back)
        assert wishes.shape is first
        until(lambda: page._undo.disabled)
    finally:
        page.close()
