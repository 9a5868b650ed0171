"""Every form of a frame in memory gives the same points; what is none gets one sentence with its cure."""

from collections.abc import Iterator
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from memory_frames import FORMS, GRID, POINTS, Tensor, TensorMap, message, records, with_data
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.io.point_arrays import is_frame_list, model_points, points_of

CAMERA = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)
DEPTH = DepthImage(np.ones((6, 8)), CAMERA)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_points(form: str) -> None:
    cloud, lost = points_of(FORMS[form])
    assert isinstance(cloud, PointCloud) and lost == 0
    assert cloud.points.dtype == np.float64 and type(cloud.points) is ndarray
    assert_array_equal(cloud.points, POINTS)
    assert not is_frame_list(FORMS[form])


def test_own_types_are_returned_and_others_are_copied_in_all_their_digits() -> None:
    assert points_of(DEPTH, drop_invalid=True) == (DEPTH, 0)
    fine = default_rng(1).normal(size=(9, 3))
    cloud, _ = points_of(fine)
    assert isinstance(cloud, PointCloud)
    assert_array_equal(cloud.points, fine)
    assert not np.shares_memory(cloud.points, fine)


def broken(points: ndarray) -> ndarray:
    """The points with three that are no measurements: the second, the fourth and the tenth."""
    made = points.copy().reshape(-1, 3)
    made[1], made[3, 2], made[9] = nan, -np.inf, 0
    return made.reshape(points.shape)


MEASURED = np.delete(POINTS, [1, 3, 9], axis=0)

KINDS = {
    "array": lambda points: points,
    "tensor": lambda points: torch.tensor(points, dtype=torch.bfloat16),
    "structured": records,
    "message": message,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("points", [POINTS, GRID], ids=["flat", "organized"])
def test_missing_points_are_refused_or_dropped_and_counted(kind: str, points: ndarray) -> None:
    cure = "leave them out with drop_invalid=True$"
    if points.ndim == 3:
        cure = "organized clouds mark pixels without a measurement so, and drop_invalid=True leaves them out$"
    with pytest.raises(ValueError, match=rf"^the .* has 3 of 12 points .*\(NaN or infinite\).*: {cure}"):
        points_of(KINDS[kind](broken(points)))
    cloud, lost = points_of(KINDS[kind](broken(points)), drop_invalid=True)
    assert isinstance(cloud, PointCloud) and lost == 3
    assert_array_equal(cloud.points, MEASURED)


@pytest.mark.parametrize("made", [POINTS, records(POINTS)], ids=["array", "structured"])
def test_masked_values_are_missing(made: ndarray) -> None:
    masked = np.ma.masked_array(made)
    masked[4] = np.ma.masked
    with pytest.raises(ValueError, match="has 1 of 12 points without a measurement"):
        points_of(masked)
    cloud, lost = points_of(masked, drop_invalid=True)
    assert isinstance(cloud, PointCloud) and lost == 1
    assert_array_equal(cloud.points, np.delete(POINTS, 4, axis=0))


def test_other_marks_of_missing_points() -> None:
    for mark, words in ((0.0, r"exactly \(0, 0, 0\)"), (1e13, "beyond 1e.12")):
        made = POINTS.copy()
        made[2] = mark
        with pytest.raises(ValueError, match=rf"1 of 12 points without a measurement \({words}\)"):
            points_of(made)
        assert points_of(made, drop_invalid=True)[1] == 1
    wide = np.full((2, 3), np.finfo(np.longdouble).max)  # beyond 64-bit floats where this processor has longer ones
    with pytest.raises(ValueError, match="all 2 points"):
        points_of(wide, drop_invalid=True)


def generated() -> Iterator[list[float]]:
    yield [1.0, 2.0, 3.0]


def altered(**changes: Any) -> SimpleNamespace:
    """A message whose field of z is another."""
    made = message(POINTS)
    vars(made.fields[2]).update(changes)
    return made


IMAGE = "is an image of depths, which needs the camera's intrinsics: give intrinsics=, .* or mereo.DepthImage.depth, "

REFUSED = {
    "number": (3.5, "^the float cannot be read as points"),
    "generator": (generated(), "^the generator cannot be read as points"),
    "empty tensor map": (SimpleNamespace(point=TensorMap()), "^the SimpleNamespace cannot be read as points"),
    "class": (trimesh.PointCloud, "^the ABCMeta cannot be read as points"),
    "table": (SimpleNamespace(columns=["z", "y", "x"], points=POINTS), r"is a table.*give table\[\['x', 'y', 'z'\]\]"),
    "frames in lists": ((POINTS.tolist(),), "^the tuple holds 1 frame; one"),
    "four columns": (np.ones((9, 4)), r"^the ndarray of shape .9, 4. is not a point cloud.*as points\[..., :3\]"),
    "transposed": (np.ones((3, 500)), "has x, y and z on its first axis; they must be on the last: give points.T"),
    "depths": (np.ones((480, 640), np.float32), f"^the ndarray of shape .480, 640. {IMAGE}"),
    "depths with a channel": (np.ones((480, 640, 1)), IMAGE),
    "depths with a channel in front": (torch.ones(1, 480, 640), IMAGE),
    "color": (np.ones((480, 640, 3), np.uint8), "is a color image, which shows no positions"),
    "channels in front": (np.ones((3, 6, 8)), r"x, y and z on its first axis.*np.moveaxis\(points, 0, -1\)"),
    "batch": (np.ones((2, 6, 8, 3)), "is not a point cloud"),
    "complex": (np.ones((9, 3), complex), "has values of type complex128; they must be real numbers: give an arr"),
    "objects": (POINTS.astype(object), "has values of type object"),
    "ragged": ([[1, 2, 3], [4, 5]], "^the list is no array .its rows differ in length.; n x 3 numbers are needed: "),
    "tensor without values": (torch.ones(9, 3, device="meta"), "^the Tensor is no array"),
    "empty message": (message(POINTS[:0]), "^the PointCloud2 message holds 0 points"),
    "only NaN": (np.full((6, 3), nan), "^all 6 points of the ndarray of shape .6, 3. are NaN, infinite, zero"),
    "fields": (np.ones(9, [("u", "f4"), ("v", "f4")]), "has the fields u, v; x, y and z are needed: rename"),
    "field of words": (np.ones(9, [("x", "f4"), ("y", "U3"), ("z", "f4")]), "^the field 'y' of .* values of type <U3"),
    "field of rows": (np.ones(9, [("x", "f4", 2), ("y", "f4"), ("z", "f4")]), "'x' of .* holds several numbers"),
    "message without z": (altered(name="w"), "its fields are x, y, w, without x, y and z"),
    "message cut short": (with_data(message(POINTS), lambda d: d[:-1]), "truncated: 227 of 228 bytes.: take another"),
    "field outside of the point": (altered(offset=17), "^the PointCloud2 message cannot be read"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_frame_gets_one_sentence(case: str) -> None:
    source, expected = REFUSED[case]
    with pytest.raises(ValueError, match=expected) as caught:
        points_of(source)
    sentence = str(caught.value)
    assert "\n" not in sentence and ": " in sentence and not sentence.endswith(".") and "--" not in sentence


FRAME_LISTS = {
    "arrays of equal length": (POINTS, POINTS),
    "arrays of one point": [POINTS[:1], POINTS[:1]],
    "tensors of another library": [Tensor(POINTS)],
    "structured arrays": [records(POINTS), records(GRID)],
    "paths": ["a.ply", Path("b.ply")],
    "depth images": [DEPTH],
    "one point in a list": [[[1, 2, 3]]],
    "lists of arrays": [list(POINTS), list(POINTS)],
    "open3d": [FORMS["open3d"]],
    "messages": [message(POINTS)],
    "with one that is none": [None, POINTS],
}
NO_FRAME_LISTS = (
    *([[1, 2, 3], [4, 5, 6], [7, 8, 9]], list(POINTS), list(torch.tensor(POINTS)), list(records(POINTS)), [1, 2, 3]),
    *([], [[], []], [None], np.stack([POINTS, POINTS]), {"a": POINTS}, {"a.ply"}, "ab", Path("a.ply")),
)


@pytest.mark.parametrize("case", FRAME_LISTS)
def test_lists_of_frames(case: str) -> None:
    assert is_frame_list(FRAME_LISTS[case])
    with pytest.raises(ValueError, match="holds .* frames?; one is needed"):
        points_of(FRAME_LISTS[case])


def test_points_of_a_model_may_be_its_origin_and_must_be_finite() -> None:
    for form in (
        [[0, 0, 0], [1, 2, 3]],
        np.array([[0.0, 0, 0], [1, 2, 3]]),
        PointCloud(np.array([[0.0, 0, 0], [1, 2, 3]])),
    ):
        assert_array_equal(model_points(form), [[0, 0, 0], [1, 2, 3]])
    for wrong in ([[0, 0, nan]], np.empty((0, 3)), [[1e13, 0, 0]]):
        with pytest.raises(
            ValueError, match=r"of shape .* has no points, or some that are NaN, infinite or beyond 1e.12"
        ):
            model_points(wrong)
    with pytest.raises(
        ValueError, match="a depth image is no part of an object's files: carry points, a mesh or a file"
    ):
        model_points(DEPTH)


def test_what_is_no_list_of_frames() -> None:
    assert [source for source in NO_FRAME_LISTS if is_frame_list(source)] == []


def test_normals_of_other_libraries_come_with_the_points() -> None:
    ball = trimesh.creation.icosphere()
    cloud, _ = points_of(ball)
    assert isinstance(cloud, PointCloud) and cloud.normals is not None
    assert_allclose(cloud.normals, ball.vertices, atol=0.05)
    longer, lost = points_of(SimpleNamespace(points=broken(POINTS), normals=3.0 * POINTS), drop_invalid=True)
    assert isinstance(longer, PointCloud) and lost == 3
    assert_allclose(longer.normals, MEASURED / norm(MEASURED, axis=1, keepdims=True))
    for normals in ([], POINTS[:3], np.full(POINTS.shape, nan), "none"):
        assert points_of(SimpleNamespace(points=POINTS, normals=normals))[0].normals is None  # type: ignore[union-attr]
