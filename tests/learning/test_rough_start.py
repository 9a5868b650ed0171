"""Start files: what they may say, and one sentence for each thing that they may not."""

import json
from pathlib import Path

import numpy as np
import pytest
from align_cases import object_at_rest
from scipy.spatial.transform import Rotation

from mereo.geometry.transforms import rigid, transform_points
from mereo_learning.placement import read_start

SCALE = 2.5
TURN = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix()
POSE = rigid(SCALE * TURN, np.array([1.0, 2.0, 3.0]))
MODEL = np.array([[0.0, 0, 0], [20, 0, 0], [0, 12, 0], [30, 5, 8]])


def pairs(model: np.ndarray = MODEL, pose: np.ndarray = POSE) -> dict[str, list[list[float]]]:
    return {"model": model.tolist(), "scan": transform_points(pose, model).tolist()}


def write(folder: Path, value: object) -> Path:
    path = folder / "start.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def test_exact_pairs_and_matrices_give_the_pose_and_a_segment_may_have_its_own(tmp_path: Path) -> None:
    rest = object_at_rest()
    by_pairs = read_start(write(tmp_path, {"object": pairs()}), rest, SCALE)
    np.testing.assert_allclose(by_pairs.poses, np.stack([POSE] * 3), atol=1e-9)
    assert not by_pairs.separate.any()
    by_matrix = read_start(write(tmp_path, {"object": POSE.tolist()}), rest)
    np.testing.assert_allclose(by_matrix.poses[0], POSE, atol=1e-9)
    other = rigid(SCALE * np.eye(3), np.array([5.0, 6.0, 7.0]))
    start = read_start(
        write(tmp_path, {"object": pairs(), "segments": {"arm": pairs(pose=other)}}), object_at_rest(), SCALE
    )
    assert start.separate.tolist() == [False, True, False]
    np.testing.assert_allclose(start.poses, [POSE, other, POSE], atol=1e-9)
    assert start.how == "object; arm from start.json"


def test_the_known_scale_is_kept_and_the_middle_stays_and_a_missing_file_is_named(tmp_path: Path) -> None:
    """A matrix of a scale that is 5 % off: size from the units, place and turn from the matrix."""
    rest, rough = object_at_rest(), rigid(1.05 * SCALE * TURN, np.array([1.0, 2.0, 3.0]))
    pose = read_start(write(tmp_path, {"object": rough.tolist()}), rest, SCALE).poses[0]
    np.testing.assert_allclose(pose[:3, :3], SCALE * TURN, atol=1e-9)
    middle = rest.bounds.mean(axis=0)
    np.testing.assert_allclose(transform_points(pose, middle), transform_points(rough, middle))
    with pytest.raises(FileNotFoundError, match="gone.json does not exist; a start file is needed"):
        read_start(tmp_path / "gone.json", object_at_rest())


SPREAD = np.array([[0.0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0], [0, 0, 9]])
SADDLE = SCALE * SPREAD + np.outer([-15, 15, -15, 15, 0], [0, 0, 1])
TWISTED = {"model": SPREAD.tolist(), "scan": SADDLE.tolist()}
MIRROR = POSE @ np.diag([-1.0, 1, 1, 1])


@pytest.mark.parametrize(
    "stated, scale, sentence",
    [
        ({}, SCALE, 'it has neither "object" nor "segments"'),
        ({"object": pairs(), "scale": 3}, SCALE, "has the key 'scale'; it may have"),
        ({"segments": {"leg": pairs()}}, SCALE, "start of the segment 'leg'; the segments are base, arm, peg"),
        ({"segments": {"arm": pairs()}}, SCALE, "no start for the segment 'base' and none of the object"),
        ({"object": pairs(MODEL[:2])}, SCALE, "2 points of the model and 2 of the scan; at least 3 pairs"),
        ({"object": {**pairs(), "scan": "here"}}, SCALE, "scan of the start of the object must be rows of 3 finite"),
        ({"object": pairs(np.outer([0, 1, 2, 3], [1.0, 2, 3]))}, SCALE, "lie on a line; they must span a triangle"),
        ({"object": pairs(pose=MIRROR)}, SCALE, "the pairs of the object fit a mirror image better"),
        ({"object": pairs(SPREAD), "segments": {"arm": TWISTED}}, SCALE, "pairs of segment 'arm' are 13.4 apart"),
        ({"object": pairs()}, None, "about 2.5 scan units per scene unit.: give the scene's unit with --scene-unit-mm"),
        ({"object": pairs()}, 2500.0, "has 2.5 scan units per scene unit, but the units of scene and scan give 2500"),
        ({"object": MIRROR.tolist()}, SCALE, "is a reflection"),
        ({"object": np.diag([1.0, 2, 1, 1]).tolist()}, None, "shears or stretches"),
        ({"object": POSE.T.tolist()}, SCALE, "has the last row .*; it must be 0 0 0 1: is it transposed?"),
        (
            {"object": {"model": SPREAD.tolist(), "scan": (1e300 * SPREAD).tolist()}},
            SCALE,
            "finite numbers up to 1e.12",
        ),
    ],
)
def test_bad_starts(tmp_path: Path, stated: object, scale: float | None, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_start(write(tmp_path, stated), object_at_rest(), scale)
