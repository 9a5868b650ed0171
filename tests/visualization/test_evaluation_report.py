"""The page of an evaluation holds its figures, nothing from outside, and stays small."""

import base64
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from mereo.visualization.evaluation_report import write_evaluation_report
from mereo.visualization.reconstruction_report import BUDGET_BYTES

METRICS = {
    "weights": "bunny",
    "scene": "<b>bunny</b>",
    "seed": 1_000_000,
    "examples": 2,
    "iou": 0.91234,
    "miou": 0.81234,
    "definition": "100^3 cells",
    "per_segment": {"body": 0.95, "</script>": float("nan")},
    "example_mean": {"iou": 0.7, "miou": float("nan")},
    "per_example": {"bunny 0": {"iou": 0.8, "miou": 0.7}, "bunny 1": {"iou": 0.6, "miou": float("nan")}},
    "ece": 0.1234,
    "reliability": [
        {"confidence": 0.25, "right": 0.5, "share": 0.64},
        {"confidence": 0.75, "right": 1.0, "share": 0.36},
    ],
    "confusion": np.array([[90, 10, 0], [20, 60, 0], [0, 0, 0]]),
}
COLORS = ((86, 180, 233), (230, 159, 0))


def write(folder: Path, picture: np.ndarray) -> str:
    Image.fromarray(picture).save(folder / "errors.png")
    write_evaluation_report(folder / "r.html", METRICS, COLORS, folder / "errors.png")
    return (folder / "r.html").read_text(encoding="utf-8")


def test_the_page_holds_every_figure_and_nothing_from_outside(tmp_path: Path) -> None:
    page = write(tmp_path, np.zeros((8, 8, 3), dtype=np.uint8))
    words = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL))
    for text in ("0.912", "0.812", "0.700", "0.950", "seed: 1000000", "100^3 cells", "90.0", "25.0", "75.0"):
        assert text in words, text
    assert page.index("bunny 1") < page.index("bunny 0")  # the worst comes first
    assert "<script" not in page and "</script>" not in page
    assert "<b>bunny</b>" not in page
    assert not re.search(r"https?://|@import|url\(", page)
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert base64.b64decode(data) == (tmp_path / "errors.png").read_bytes()


def test_the_reliability_diagram_says_what_its_axes_are(tmp_path: Path) -> None:
    page = write(tmp_path, np.zeros((8, 8, 3), dtype=np.uint8))
    (drawn,) = re.findall(r"<svg class=\"rel\".*?</svg>", page)
    tree = ElementTree.fromstring(drawn)
    words = [text.text for text in tree.iter("text")]
    assert words == ["0", "1", "confidence in a cell's label", "0", "1", "share that is right"]
    assert tree.find("polyline").attrib["points"] == "65.0,130.0 195.0,0.0"  # type: ignore[union-attr]
    low, top, width, height = (float(value) for value in tree.attrib["viewBox"].split())
    foot = max(float(text.attrib.get("y", 0)) for text in tree.iter("text"))
    assert low <= -18 - 11 and top <= -10 and foot + 4 <= top + height and low + width >= 260 + 10, "nothing is cut off"


def test_a_large_picture_becomes_small_enough(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, size=(2400, 2400, 3), dtype=np.uint8)
    page = write(tmp_path, noise)
    assert (tmp_path / "errors.png").stat().st_size > BUDGET_BYTES
    assert 1_000_000 < (tmp_path / "r.html").stat().st_size <= BUDGET_BYTES
    assert "data:image/jpeg;base64," in page
