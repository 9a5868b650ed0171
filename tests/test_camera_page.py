"""docs/cameras.md: its table follows our formulas, and its code for a mask makes one that is read."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_documentation import ROOT, blocks

from mereo.io.config import InputConfig
from mereo.io.readers import read_mask
from mereo.io.sensor_frame import read_frame
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


def run_block(word: str) -> None:
    """Run the page's only Python block that has this word, in the current folder."""
    (code,) = (code for code in blocks(PAGE, "python") if word in code)
    exec(compile(code, str(PAGE), "exec"), {})


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
    monkeypatch.chdir(tmp_path)
    run_block("ndimage")
    mask = read_mask(tmp_path / "mask.png")
    assert not (mask & ~ball).any() and mask.sum() > 0.9 * ball.sum()


def test_averaged_pixels_lie_on_the_same_plane_and_mix_no_surfaces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slanted plane keeps its place, a step of its depth stays a step, a hole of less than four pixels is filled."""
    camera = {"fx": 60.0, "fy": 50.0, "cx": 31.5, "cy": 20.0}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    row, column = np.mgrid[:41, :64]
    x, y = (column - camera["cx"]) / camera["fx"], (row - camera["cy"]) / camera["fy"]
    plane = 600 / (1 - 0.2 * x + 0.1 * y)  # z = 600 mm + 0.2 X - 0.1 Y
    depth = np.where(column < 33, plane, 1500)
    depth[10, 11], depth[20:22, 20:22] = 0, 0
    Image.fromarray(np.rint(depth).astype(np.uint16)).save(tmp_path / "depth.png")
    monkeypatch.chdir(tmp_path)
    run_block("half.tif")
    points = read_frame(tmp_path / "half.tif", InputConfig(tmp_path / "half.json")).cloud.points
    assert len(points) == 20 * 32 - 1
    near = points[points[:, 2] < 1.2]
    off = np.abs(near @ [-0.2, 0.1, 1.0] - 0.6)
    assert np.quantile(off, 0.9) < 0.0005, "rounding to millimetres, halved"
    assert off.max() < 0.003, "where a part of the four was measured"
    np.testing.assert_allclose(points[points[:, 2] >= 1.2, 2], 1.5, atol=1e-6)
    assert len(near) == 20 * 17 - 1, "the column on the edge has as much of both sides; the nearer one counts"
