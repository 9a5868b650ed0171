"""Pages of reconstructions and evaluations: self-contained, small, and drawn by a real browser, also without WebGL."""

import base64
import io
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from browser import Page, needs_browser, pixels_of, until
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from reported_scenes import ball, example, page_data, positions, wall

from mereo.fitting.registration.recognition import NOT_EVALUATED, Recognition, Signs
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.atomic_files import JsonObject
from mereo.results.joints import JointValue
from mereo.visualization.contact_sheets import MISSING, MOST_DEPTH_PX, depth_data
from mereo.visualization.reconstruction_report import BUDGET_BYTES, VERDICTS, Report, page_words, trust
from mereo.visualization.renderer import enclosed
from mereo.visualization.units import Unit
from mereo_learning.evaluation_report import write_evaluation_report


def test_the_page_holds_the_shapes_to_16_bits_of_the_box_and_needs_nothing_from_outside(tmp_path: Path) -> None:
    cloud, mesh, summary = example()
    Report(cloud, mesh, summary).write(tmp_path / "r.html")
    data = page_data(tmp_path / "r.html")
    step = (np.asarray(data["high"]) - data["low"]).max() / 65535
    assert_allclose(positions(data, data["cloud"]["positions"]), cloud.points, atol=step)
    for shown, segment in zip(data["segments"], mesh.segments, strict=True):
        assert_allclose(positions(data, shown["positions"]), segment.vertices, atol=step)
        indices = np.frombuffer(base64.b64decode(shown["indices"]), "<u4").reshape(-1, 3)
        assert_array_equal(indices, segment.faces)
        assert (shown["name"], tuple(shown["color"])) == (segment.name, segment.color)
    assert not data["coarsened"]
    assert data["words"]["rows"][2] == ["\N{EN DASH}", "0", None]
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|src=|@import|url\(|fetch\(|XMLHttpRequest", page)
    assert page.count("</script>") == 1
    assert "<title>A &lt;b&gt;bold&lt;/b&gt; &lt;/script&gt; title</title>" in page


@pytest.mark.parametrize(
    ("unit", "heads", "row", "voxels"),
    [
        (Unit(1.0), "centre x, y, z (mm)|volume (cm³)", [[100, 200, 300], 4189], "2.01 mm"),
        (Unit(None), "centre x, y, z (units)|volume (units³)", [[0.1, 0.2, 0.3], 4.19e-3], "0.00201 units"),
    ],
)
def test_figures_are_in_millimetres_where_the_unit_is_known(
    tmp_path: Path, unit: Unit, heads: str, row: list, voxels: str
) -> None:
    cloud, mesh, summary = example()
    Report(cloud, mesh, summary, unit=unit).write(tmp_path / "r.html")
    words = page_data(tmp_path / "r.html")["words"]
    assert words["heads"][1:3] == heads.split("|") and f"voxels of {voxels}" in words["facts"]
    place, volume, confidence = words["rows"][0]
    assert [float(value) for value in place.split()] == row[0] and confidence == 0.5
    assert float(volume.replace(",", "")) == pytest.approx(row[1], rel=0.02)


def test_the_page_counts_the_points_once_and_has_no_words_of_programs(tmp_path: Path) -> None:
    cloud, mesh, summary = example()
    told = {"explained": 0.973}
    said = {"recognition": {"known": "unsure", "reason": "a part is bent: look at it", "signs": {"size": 0.1}}}
    Report(cloud, mesh, {**summary, **said, "registration": told}).write(tmp_path / "r.html")
    data = page_data(tmp_path / "r.html")
    words = data["words"]
    assert words["facts"][0] == "your model, registered: it explains 97.3% of the points"
    text = " ".join(words["facts"])
    assert not re.search(r"float32|camera|clipped|points:|104|_", text), text
    assert data["cloud"]["count"] == len(cloud)
    assert words["trust"] == ["doubt", "Doubtful:", "a part is bent."]
    assert words["warnings"][0] == "Look at it." and "may be cut off there." in words["warnings"][1]
    assert words["timings_s"] == {"reading the points": 0.1, "field": 1.5}


@pytest.mark.parametrize("unit, ends", [(Unit(1.0), ["500 mm", "700 mm"]), (Unit(None), ["0.5 units", "0.7 units"])])
def test_the_page_has_the_depth_image_where_there_is_one(tmp_path: Path, unit: Unit, ends: list[str]) -> None:
    cloud, mesh, summary = example()
    Report(cloud, mesh, summary, unit=unit, depth=wall(80, 60)).write(tmp_path / "r.html")
    told = page_data(tmp_path / "r.html")["depth"]
    assert told["ends"] == ends
    kind, _, content = told["url"].partition(",")
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB"))
    assert kind == "data:image/png;base64" and picture.shape[:2] == (told["height"], told["width"])
    # what was measured, and a little around it: 20 x 15 pixels
    assert (picture != np.array(MISSING)).any(axis=2).sum() == 20 * 15 and picture.shape[:2] == (19, 24)
    Report(cloud, mesh, summary).write(tmp_path / "none.html")
    assert page_data(tmp_path / "none.html")["depth"] is None


def test_large_and_empty_depth_images_are_small_pictures() -> None:
    large = depth_data(wall(4000, 3000), Unit(1.0))
    assert MOST_DEPTH_PX / 2 < large["width"] <= MOST_DEPTH_PX and len(large["url"]) < 100_000
    empty = depth_data(DepthImage(np.zeros((4, 6)), Camera.from_fov(6, 4, 0.7)), Unit(1.0))
    assert (empty["width"], empty["height"], empty["ends"]) == (6, 4, [])


def test_a_large_reconstruction_stays_under_the_budget_and_in_shape(tmp_path: Path) -> None:
    cloud, _, summary = example()
    mesh = SegmentedMesh(tuple(ball(f"s{i}", 0.2 * i, i, level=6) for i in range(3)))
    Report(PointCloud(np.tile(cloud.points, (700, 1))), mesh, summary).write(tmp_path / "r.html")
    assert 1_000_000 < (tmp_path / "r.html").stat().st_size <= BUDGET_BYTES
    data = page_data(tmp_path / "r.html")
    assert data["coarsened"]
    for i, shown in enumerate(data["segments"]):
        distance = norm(positions(data, shown["positions"]) - [0.2 * i, 0, 0.5], axis=1)
        assert_allclose(distance, 0.1, atol=0.002)
    with pytest.raises(ValueError, match="at most 5000000: shorten the summary"):
        Report(cloud, mesh, {"title": "x" * BUDGET_BYTES}).write(tmp_path / "r2.html")
    assert not (tmp_path / "r2.html").exists()


@needs_browser
@pytest.mark.parametrize("width, is_phone", [(1200, False), (390, True)])
def test_a_page_has_one_legend_and_a_scale_bar_and_is_folded_on_a_phone(
    tmp_path: Path, width: int, is_phone: bool
) -> None:
    cloud, mesh, summary = example()
    joints = {
        "a": JointValue(0.5, (0.499, 0.501), "rad", (0.0, 1.0)),
        "b </script>": JointValue(0.5, None, "m", (0, 1)),
    }
    summary |= {"joints": {name: joint.facts() for name, joint in joints.items()}}
    Report(cloud, mesh, summary, unit=Unit(1.0)).write(tmp_path / "r.html")
    with Page(tmp_path, "about:blank", (width, 844)) as page:
        page.call("Emulation.setTouchEmulationEnabled", enabled=is_phone, maxTouchPoints=2)
        page.call("Page.navigate", url=(tmp_path / "r.html").as_uri())
        until(lambda: page.evaluate("document.querySelectorAll('#scale line').length") == 6)
        is_open, swatches, hint, label = page.evaluate(
            "[$('settings').open, document.querySelectorAll('td .swatch').length, $('hint').innerText, "
            "$('scale').getAttribute('aria-label')]"
        )
        assert is_open is not is_phone and swatches == 0 and ("pinch to zoom" in hint) is is_phone
        told = re.fullmatch(r"scale bar and axes of the camera: x right, y down, z away, each (\d+) cm long", label)
        cells = page.evaluate("[...document.querySelectorAll('#joints td')].map(cell => cell.innerText)")
        assert cells == ["a", "28.65° (28.59 to 28.71)", "b </script>", "500 mm"]
        # as many pixels as the length has at the depth of the object's middle
        pixels, per_metre = page.evaluate(
            "[190 - $('scale').querySelector('.bar').x1.baseVal.value, "
            "lens()[0] / view.distance / radius * canvas.clientWidth / 2]"
        )
        assert told and pixels == pytest.approx(int(told[1]) / 100 * per_metre)


def test_a_segment_around_another_one_is_seen_through_though_it_is_not_declared(tmp_path: Path) -> None:
    inner = ball("inner", 0.0, 0)
    middle = inner.vertices.mean(axis=0)
    around = replace(inner, name="around", vertices=middle + 2 * (inner.vertices - middle))
    cup = replace(around, faces=around.faces[(around.vertices[around.faces] - middle)[:, :, 0].max(axis=1) < 0.1])
    assert enclosed(SegmentedMesh((around, inner))) == {(1, 0)}, "in any order"
    assert enclosed(SegmentedMesh((inner, cup))) == set()
    Report(example()[0], SegmentedMesh((inner, around)), {}).write(tmp_path / "r.html")
    assert [segment["opacity"] for segment in page_data(tmp_path / "r.html")["segments"]] == [1.0, 0.4]


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("mode", ["", "#2d"])
def test_a_browser_draws_every_segment(tmp_path: Path, mode: str) -> None:
    cloud, mesh, summary = example()
    Report(cloud, mesh, summary).write(tmp_path / "r.html")
    with Page(tmp_path, (tmp_path / "r.html").as_uri() + mode, (1000, 800)) as page:
        drawing = until(lambda: re.search(r'data-drawing="(\w+)"', page.evaluate("document.documentElement.outerHTML")))
        text = drawing.string
        picture = page.screenshot()
    assert drawing[1] == "canvas" or not mode
    table = re.search(r'<table id="table">(.*?)</table>', text, re.DOTALL)
    assert table
    assert "tail &lt;/script&gt;&lt;b&gt;" in table[1]
    assert "0.1&nbsp;&nbsp;&nbsp;0.2&nbsp;&nbsp;&nbsp;0.3" in table[1]
    stage = picture[150:500, 40:680].astype(float)
    for segment in mesh.segments[:2]:
        assert pixels_of(stage, segment.color) > 1000, f"{segment.name} is not to be seen"
    drawn = np.flatnonzero((np.ptp(stage, axis=-1) > 60).any(axis=0))
    assert np.ptp(drawn) > 0.8 * stage.shape[1], "the object does not fill the canvas"


def test_places_and_volumes_are_told_as_exactly_as_they_are_known() -> None:
    """Two digits of the radius, and as many decimals of all: 593 mm ± 0.187 would be neither."""
    place = np.array([-0.02474, -0.000001, 1.592631])
    assert Unit(1.0).place(place, 0.000187) == "-24.74 0.00 1,592.63 ± 0.19"
    assert Unit(1.0).place(place, 0.0403) == "-25 0 1,593 ± 40"
    assert Unit(None).place(place, 0.0) == "-0.0247 -1e-06 1.59 ± 0", "without an error as without a radius"
    assert Unit(0.01).volume(648.0, (633.2, 663.1)) == "648 (633 to 663)"
    assert Unit(None).volume(4.9012, (4.889, 4.9204)) == "4.901 (4.889 to 4.920)"
    assert Unit(None).volume(190.0721, (190.0719, 190.0723)) == "190.1", "of a rigid object"
    assert Unit(None).volume(1575.0, (1574.99, 1575.01)) == "1,575"
    assert Unit(None).volume(0.0190072, (0.0189981, 0.0190163)) == "0.01901 (0.01900 to 0.01902)"


FIT = {"explained": 0.989, "accepted": True}
NOTHING = "Network alone: nothing says whether this is the object."


def recognized(known: bool | str, reason: str | None = None) -> Recognition:
    return Recognition(known, reason, Signs(size=0.01, unexplained=0.2))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "recognition, registration, level, line, cure",
    [
        (recognized(True), FIT, "yes", "Trust it: the frame shows the object; the model explains 98.9 %", None),
        (recognized("unsure", "3% are not: look, or crop"), FIT, "doubt", "Doubtful: 3% are not.", "look, or crop"),
        (recognized(False, "size: unit (-u: m)"), FIT, "no", "Do not trust it: size.", "unit (-u: m)"),
        (recognized(False), FIT, "no", "Do not trust it: it was not recognized.", None),
        (recognized(True), {**FIT, "accepted": False}, "doubt", "Doubtful: it was not recognized.", None),
        (Recognition(False, "the object is lost"), None, "no", "Do not trust it: the object is lost.", None),
        (NOT_EVALUATED, None, "alone", NOTHING, None),
        (None, None, "alone", NOTHING, None),
    ],
)
def test_a_verdict_is_one_line_with_its_reason(
    recognition: Recognition | None, registration: JsonObject | None, level: str, line: str, cure: str | None
) -> None:
    summary = {} if recognition is None else {"recognition": recognition.facts()}
    found = trust(summary if registration is None else {**summary, "registration": registration})
    verdict = f"{VERDICTS[found.level]}: {found.why}.".replace("\N{NO-BREAK SPACE}", " ")
    assert (found.level, found.cure) == (level, cure) and verdict.startswith(line)


@pytest.mark.parametrize("fit", [FIT, None])
@pytest.mark.parametrize("known", [True, "unsure", False])
def test_report_summary_and_exit_status_say_the_same(known: bool | str, fit: JsonObject | None) -> None:
    """Only what is known and the model's own answer can be relied on without looking."""
    signs = None if fit is None else Signs(size=0.01, unexplained=0.2)
    recognition = Recognition(known, None if known is True else "it is bent: look", signs)  # type: ignore[arg-type]
    summary = {"recognition": recognition.facts(), "registration": fit}
    level, word, _ = page_words(summary, Unit(None))["trust"]
    verdict = trust(summary)
    assert (level, word) == (verdict.level, f"{VERDICTS[verdict.level]}:")
    unsure = ("Network alone" if fit is None else "Doubtful", 4)
    expected = {True: unsure if fit is None else ("Trust it", 0), "unsure": unsure, False: ("Do not trust it", 3)}
    assert (VERDICTS[verdict.level], verdict.status) == expected[known]


@pytest.mark.parametrize("junk", [None, 3, [], {"known": None, "explained": float("nan"), "answer": 7}])
def test_a_damaged_summary_is_not_trusted(junk: object) -> None:
    assert trust({"recognition": junk, "registration": junk}).level not in ("yes", "doubt")


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


def write_evaluation(folder: Path, picture: np.ndarray) -> str:
    Image.fromarray(picture).save(folder / "errors.png")
    write_evaluation_report(folder / "r.html", METRICS, COLORS, folder / "errors.png")
    return (folder / "r.html").read_text(encoding="utf-8")


def test_the_page_of_an_evaluation_holds_every_figure_and_nothing_from_outside(tmp_path: Path) -> None:
    page = write_evaluation(tmp_path, np.zeros((8, 8, 3), np.uint8))
    words = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL))
    for text in ("0.912", "0.812", "0.700", "0.950", "seed: 1000000", "100^3 cells", "90.0", "25.0", "75.0"):
        assert text in words, text
    assert page.index("bunny 1") < page.index("bunny 0")  # the worst comes first
    assert "<script" not in page and "</script>" not in page
    assert "<b>bunny</b>" not in page
    assert not re.search(r"https?://|@import|url\(", page)
    (data,) = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert base64.b64decode(data).startswith(b"\xff\xd8")
    (drawn,) = re.findall(r"<svg class=\"rel\".*?</svg>", page)
    tree = ElementTree.fromstring(drawn)
    words = [text.text for text in tree.iter("text")]
    assert words == ["0", "1", "confidence in a cell's label", "0", "1", "share that is right"]
    assert tree.find("polyline").attrib["points"] == "65.0,130.0 195.0,0.0"  # type: ignore[union-attr]
    low, top, width, height = (float(value) for value in tree.attrib["viewBox"].split())
    foot = max(float(text.attrib.get("y", 0)) for text in tree.iter("text"))
    assert low <= -18 - 11 and top <= -10 and foot + 4 <= top + height and low + width >= 260 + 10, "nothing is cut off"


def test_a_large_picture_becomes_small_enough(tmp_path: Path) -> None:
    noise = default_rng(0).integers(0, 256, size=(2400, 2400, 3), dtype=np.uint8)
    page = write_evaluation(tmp_path, noise)
    assert (tmp_path / "errors.png").stat().st_size > BUDGET_BYTES
    assert 1_000_000 < (tmp_path / "r.html").stat().st_size <= BUDGET_BYTES
    assert "data:image/jpeg;base64," in page
