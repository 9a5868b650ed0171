"""docs/cameras.md: its table follows our formulas, and its code for a mask makes one that is read."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_documentation import ROOT, blocks

from mereo.io.readers import read_mask
from mereo.synthesis.config import SensorModel
from mereo.synthesis.depth_sensor import KINECT_DISPARITY_M, axial_std_m, quantize

PAGE = ROOT / "docs" / "cameras.md"


def axial_mm(z_m: float, degrees: float, model: SensorModel) -> float:
    return 1e3 * float(axial_std_m(np.array([z_m]), np.deg2rad([degrees]), model)[0])


def test_the_table_of_distances_follows_the_formulas() -> None:
    rows = re.findall(
        r"^\| ([\d.]+) \| ([\d.]+), ([\d.]+) \| ([\d.]+) \| ([\d.]+), ([\d.]+) \|", PAGE.read_text(), re.M
    )
    assert len(rows) == 6
    for z, *stated in np.array(rows, dtype=float).tolist():
        light, flight = ([axial_mm(z, degrees, model) for degrees in (0, 60)] for model in models())
        expected = (*light, 1e3 * z**2 / KINECT_DISPARITY_M, *flight)
        assert stated == pytest.approx(expected, abs=0.0051)
    depths = np.unique(quantize(np.linspace(0.99, 1.01, 10_000), 1.0))
    assert 1e3 * np.median(np.diff(depths)) == pytest.approx(2.85, abs=0.02), "the step as it is simulated"


def models() -> tuple[SensorModel, SensorModel]:
    return "structured-light", "time-of-flight"


def test_pixels_on_ten_centimetres_follow_from_the_focal_length() -> None:
    for z, *pixels in re.findall(r"^\| ([\d.]+) \|.*\| (\d+) \| (\d+) \|$", PAGE.read_text(), re.M):
        assert [int(value) for value in pixels] == [round(0.1 * focal / float(z)) for focal in (420, 525)]


def test_the_colour_threshold_finds_the_orange_ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The largest orange thing, and nothing of a smaller one, of specks and of other colours."""
    row, column = np.mgrid[:120, :160]
    ball = (row - 60) ** 2 + (column - 70) ** 2 < 30**2
    picture = np.full((120, 160, 3), (60, 90, 200), np.uint8)
    picture[ball] = (250, 110, 20)
    picture[10:30, 130:150] = (250, 110, 20)
    picture[100, 5] = (250, 110, 20)
    Image.fromarray(picture).save(tmp_path / "color.png")
    (code,) = (code for code in blocks(PAGE, "python") if "ndimage" in code)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "cameras.md", "exec"), {})
    mask = read_mask(tmp_path / "mask.png")
    assert not (mask & ~ball).any() and mask.sum() > 0.9 * ball.sum()
