"""What a user sees after a mistake: one line that says value, rule and cure, exit code 2, and nothing half-written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from shapes import ball

from mereo import __main__ as command_line
from mereo.geometry.mesh import SegmentedMesh, check_segment


def refused(capsys: pytest.CaptureFixture[str], folder: Path, text: str, *arguments: object) -> None:
    """The command fails with one line that contains ``text`` and makes no output."""
    before = sorted(folder.rglob("*"))
    code = command_line.main([str(a) for a in arguments])
    message = capsys.readouterr().err.strip()
    assert code == 2, message
    assert message.startswith("mereo: error: ") and "\n" not in message, message
    assert text in message, message
    assert sorted(folder.rglob("*")) == before


def cloud(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).normal(loc=(0.0, 0.0, 20.0), size=(count, 3))


BAD_CLOUDS = {
    "missing": (None, "missing.npy"),
    "too few": (cloud(20), "has 20 points; a reconstruction needs at least 32"),
    "behind": (cloud() - [0.0, 0.0, 40.0], "behind the camera"),
    "one place": (np.ones((100, 3)), "all points coincide"),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_bad_clouds(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, text = BAD_CLOUDS[case]
    path = tmp_path / "missing.npy"
    if points is not None:
        np.save(path, points)
    refused(capsys, tmp_path, text, "reconstruct", path, "--weights", "rope", "--output", tmp_path / "out")


@pytest.mark.parametrize("number", ["1e400", "1e300", "nan"])
def test_a_mesh_beyond_all_numbers(number: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places, faces = f"v 0 0 0\nv {number} 0 0\nv 0 1 0\nv 0 0 1\n", "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part.obj").write_text(places + faces)
    text = "part.obj cannot be read as a mesh (its part 'part' has vertices that are NaN, infinite or beyond 1e+12)"
    refused(capsys, tmp_path, text, "learn", tmp_path / "part.obj", "--output", tmp_path / "out")


def test_bad_segments_are_named_with_the_cure() -> None:
    whole = ball((0, 0, 0), 1.0, level=3)
    vertices, faces = whole.vertices, whole.faces
    cases = {
        r"segment 'ball' has 3 open edges; it must be closed: fill its holes": replace(whole, faces=faces[1:]),
        r"segment 'ball' has volume -.*it must be positive.*reverse them": replace(whole, faces=faces[:, ::-1]),
        r"edges whose faces disagree": replace(whole, faces=np.concatenate([faces[:1, ::-1], faces[1:]])),
        r"NaN or infinite vertices": replace(whole, vertices=np.where(vertices > 0.99, np.nan, vertices)),
        r"refers to vertex 700 of 642": replace(whole, faces=np.concatenate([faces, [[0, 1, 700]]])),
        r"has no faces": replace(whole, faces=faces[:0]),
    }
    check_segment(whole)
    for text, segment in cases.items():
        with pytest.raises(ValueError, match=text):
            check_segment(segment)


def test_segment_names_are_unique_and_few() -> None:
    part = ball((0, 0, 0), 1.0, level=1)
    many = tuple(replace(part, name=str(i)) for i in range(255))
    for parts, text in (((part, part), "'ball' is used twice"), ((), "0 segments"), (many, "at most 254")):
        with pytest.raises(ValueError, match=text):
            SegmentedMesh(parts)


def test_nothing_is_found_where_nothing_ever_was_in_training() -> None:
    """An untrained network says anything anywhere; outside its domain the answer is empty all the same."""
    wild = untrained(("a", "b"))
    code = wild.encode(cloud())
    places = code.normalizer.invert(np.random.default_rng(1).uniform(-4, 4, size=(3000, 3)))
    outside = (np.abs(code.normalizer.apply(places)) > 1.5).any(axis=1)
    said = wild.query(code, places).label
    answer = replace(wild, domain=((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))).query(code, places)
    assert (said[outside] > 0).any() and np.array_equal(answer.label[~outside], said[~outside])
    assert (answer.label[outside] == 0).all() and answer.probability[outside, 0].min() > 0.999
