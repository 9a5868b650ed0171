"""``report.html``: one self-contained page that shows the input cloud and the segments, offline, in any browser.

    Report -write-> report.html -read_report-> WrittenReport
    summary of a result -trust-> Trust (a verdict, why, and what to do)
                        -page_words-> all text of the page, in known units

The page is ``report.html`` next to this module with its data, one line of JSON, in place of one marker. Positions are
16-bit steps of the joint box and travel as base64, so that the page stays under ``BUDGET_BYTES``; surfaces over the
budget are coarsened for the page only (``segments.glb`` keeps all). A folder of results has its surfaces in files of
their own; what was observed is in the page alone, and is read from it as data; no script is run.
"""

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int, UInt16
from numpy import ndarray
from PIL import Image
from scipy.spatial import cKDTree

from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import Explanation
from mereo.geometry.brief import rounded
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.conventions import Facts, Names
from mereo.geometry.downsampling import random_subset
from mereo.geometry.mesh import Color, Segment, SegmentColors, SegmentedMesh
from mereo.geometry.radii import Radii, describe_level
from mereo.geometry.subdivision import split_at_creases
from mereo.geometry.transforms import Indices, Labels, Matrix, Points, Subset, Vector, box_of
from mereo.io.atomic_files import JsonObject, atomic_file
from mereo.io.errors import AnyPath
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.results.joints import JointValue, JointValues
from mereo.visualization.color_scales import radius_scale
from mereo.visualization.contact_sheets import MOST_DEPTH_PX, PNG_URL, Picture, data_url, depth_data
from mereo.visualization.previews import CAMERA_VIEWS, points_on_segments
from mereo.visualization.renderer import opacities
from mereo.visualization.units import UNKNOWN, Unit

REPORT = "report.html"
"""Name of the page in a folder of results."""

BUDGET_BYTES = 5_000_000
"""Most bytes of a page."""

CLOUD_POINTS = 60_000
"""Most points of the cloud that the page shows."""

STEPS = 65535


# --- written ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Report:
    """Content of the page of a reconstruction.

    Attributes:
        cloud: the input, in its frame and units; at most ``CLOUD_POINTS`` of it are shown.
        surfaces: the segments in the same frame; those without faces are listed but not drawn, those around a nested
            one are drawn see-through.
        summary: what the page says in words; every key may be missing. ``title`` is text; ``segments`` is a list of
            ``{"name", "centroid" [3], "volume", "confidence" in 0..1}`` in the order of ``surfaces``; ``joints`` has
            facts of a ``JointValue`` by name; ``timings_s`` maps stages to seconds; facts of it are listed
            (``page_words``).
        rotation: rotation from the input's frame to the viewer's (x right, y up, z toward the viewer).
        unit: of the cloud's lengths; the page has millimetres and cubic centimetres where it is known.
        registered: the model that the last of ``surfaces`` are, in the cloud's frame, to show how sure they are.
        depth: the image that the cloud comes from, in its unit, where it comes from one.
    """

    cloud: PointCloud
    surfaces: SegmentedMesh
    summary: JsonObject
    rotation: Matrix = field(default_factory=lambda: GLTF_CAMERA_ROTATION)
    unit: Unit = UNKNOWN
    registered: Registration | None = None
    depth: DepthImage | None = None

    def write(self, path: AnyPath) -> None:
        """Write the page; raises ``ValueError`` when it cannot be brought under the budget."""
        data = self._data()
        # "</script>" inside a name must not end the script; \u003c is the same character to JSON
        text = json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
        page = files("mereo.visualization").joinpath("report.html").read_text(encoding="utf-8")
        page = page.replace("<!--TITLE-->", escape(data["words"]["title"])).replace("/*DATA*/null", text)
        encoded = page.encode("utf-8", errors="replace")
        if len(encoded) > BUDGET_BYTES:
            raise ValueError(f"the report has {len(encoded)} bytes; at most {BUDGET_BYTES}: shorten the summary")
        with atomic_file(path) as partial:
            partial.write_bytes(encoded)

    def _data(self) -> JsonObject:
        words = page_words(self.summary, self.unit)
        depth = None if self.depth is None else depth_data(self.depth, self.unit)
        points = self.cloud.points
        points = points[np.sort(random_subset(np.arange(len(points)), CLOUD_POINTS))]  # the same every time
        low, high = _joint_bounds(points, self.surfaces)
        centroids = {} if self.registered is None else explain_centroids(self.registered)
        marks = {name: point_marks(explanation, points) for name, explanation in centroids.items()}
        # binary room: the page's text takes the rest; base64 grows data by a third
        room = int((BUDGET_BYTES - 300_000 - len(json.dumps([words, depth]))) * 3 / 4) - (6 + len(marks)) * len(points)
        shown = _fit(self.surfaces, float((high - low).max()), room)
        registered, full = self.registered, self.surfaces.segments
        sure = None if registered is None else registered.uncertainty
        radii = None if registered is None or sure is None else sure.radii(registered.material)
        scale = (
            None if radii is None else radius_scale(radii.scaled(self.unit.length_factor), f" {self.unit.length_name}")
        )
        return {
            "metres": self.unit.metres,
            "low": low.tolist(),
            "high": high.tolist(),
            "rotation": np.asarray(self.rotation).tolist(),
            "cloud": {
                "count": len(self.cloud),
                "shown": len(points),
                "positions": _base64(_quantize(points, low, high)),
            },
            "segments": [
                {
                    "name": segment.name,
                    "color": list(segment.color),
                    "opacity": opacity,
                    "faces": len(segment.faces),
                    "positions": _base64(_quantize(part.vertices, low, high)),
                    "indices": _base64(part.faces.astype("<u4")),
                    "sure": None if radii is None else _radius_bytes(radii, tuple(centroids), part),
                }
                for segment, part, opacity in zip(full, shown, opacities(self.surfaces), strict=True)
            ],
            "coarsened": any(len(a.faces) != len(b.faces) for a, b in zip(full, shown, strict=True)),
            "words": words,
            "depth": depth,
            "sure": None
            if scale is None
            else {
                "stops": [list(color) for color in scale.stops],
                "weights": [list(color) for color in WEIGHTS],
                "unexplained": list(RED),
                "ends": list(scale.words),
                "title": scale.title,
                "centroids": [
                    {"name": name, "marks": _base64(marks[name]), "shares": describe_shares(explanation)}
                    for name, explanation in centroids.items()
                ],
            },
        }


def _joint_bounds(points: Points, surfaces: SegmentedMesh) -> tuple[Vector, Vector]:
    everything = np.concatenate([points, *(segment.vertices for segment in surfaces.segments)])
    low, high = box_of(everything)
    return low, np.maximum(high, low + 1e-9 * max(1.0, float(np.abs(low).max())))


def _quantize(points: Points, low: Vector, high: Vector) -> UInt16[ndarray, "n 3"]:
    return np.rint((points - low) / (high - low) * STEPS).astype("<u2")


def _base64(array: ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _fit(surfaces: SegmentedMesh, extent: float, room_bytes: int) -> list[Segment]:
    """The segments, split at their creases, and coarsened together until they take at most ``room_bytes``."""
    shown = [split_at_creases(segment)[0] for segment in surfaces.segments]
    cells = 400.0
    while (size := sum(7 * len(s.vertices) + 12 * len(s.faces) for s in shown)) > room_bytes and cells > 4:
        shown = [split_at_creases(cluster(segment, extent / cells))[0] for segment in surfaces.segments]
        # a surface meets about cells^2 cells of the grid; the factor keeps the last steps from crawling
        cells *= min(0.95, max(0.5, (max(room_bytes, 0) / size) ** 0.5))
    return shown


def cluster(segment: Segment, cell: float) -> Segment:
    """Coarser segment: vertices in one cell of a cubic grid become their mean, faces that collapse or repeat go.

    J. Rossignac and P. Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993. Fast and
    dependency-free; the result is for looking at and need not be closed.
    """
    inverse = _same(np.floor((segment.vertices - segment.vertices.min(axis=0)) / cell).astype(np.int64))[1]
    count = np.bincount(inverse)
    sums = [np.bincount(inverse, weights=segment.vertices[:, axis], minlength=len(count)) for axis in range(3)]
    faces = inverse[segment.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    first = _same(np.sort(faces, axis=1))[0]
    return Segment(segment.name, segment.color, np.stack(sums, axis=1) / count[:, None], faces[np.sort(first)])


def _same(rows: Int[ndarray, "n 3"]) -> tuple[Subset, Indices]:
    """First index of each different row, and for each row which one it is; packed, because sorting rows is slow."""
    base = int(rows.max(initial=0)) + 1
    packed = (rows[:, 0] * base + rows[:, 1]) * base + rows[:, 2]
    _, first, inverse = np.unique(packed, return_index=True, return_inverse=True)
    return first, inverse


# --- trust ------------------------------------------------------------------------------------------------------------

Level = Literal["yes", "doubt", "no", "alone"]

VERDICTS: Mapping[Level, str] = {
    "yes": "Trust it",
    "doubt": "Doubtful",
    "no": "Do not trust it",
    "alone": "Network alone",
}
"""First words of the line."""

NOT_RECOGNIZED, NOT_SURE = 3, 4
"""Exit statuses of a command with an answer that is not the object, and with one that may not be."""


@dataclass(frozen=True)
class Trust:
    """Verdict on an answer.

    Attributes:
        level: how far it can be trusted; "alone" where no model was registered, which could tell.
        why: a phrase, without a full stop.
        cure: what to do, a phrase; None where nothing is to be done, or nothing known.
    """

    level: Level
    why: str
    cure: str | None = None

    @property
    def status(self) -> int:
        """Exit status of a command that ends with this answer: 0 is what can be relied on without looking."""
        return {"yes": 0, "no": NOT_RECOGNIZED}.get(self.level, NOT_SURE)


def trust(summary: Facts) -> Trust:
    """Verdict on the answer that a summary is of, which report, summary and exit status state; any key may be missing.

    Args:
        summary: its ``recognition`` and ``registration`` are read.
    """
    recognition, registration = _block(summary, "recognition"), _block(summary, "registration")
    known = recognition.get("known")
    explained = _number(registration.get("explained"))
    if known is True and explained is not None and registration.get("accepted") is not False:
        share = f"{100 * explained:.1f}\N{NO-BREAK SPACE}% of the points"
        return Trust("yes", f"the frame shows the object; the model explains {share}")
    if known is not False and not recognition.get("signs"):
        return Trust("alone", "nothing says whether this is the object")
    # a reason is what was seen, a colon, and what to do about it
    reason = str(recognition.get("reason") or "it was not recognized")
    why, _, cure = reason.removesuffix(".").partition(": ")
    return Trust("no" if known is False else "doubt", why, cure or None)


def _block(summary: Facts, key: str) -> Facts:
    value = summary.get(key)
    return value if isinstance(value, Mapping) else {}


def _number(value: object) -> float | None:
    """The value as a finite number; None for everything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return float(value) if np.isfinite(value) else None


# --- text of the page -------------------------------------------------------------------------------------------------

STAGES = {
    "encode": "reading the points",
    "fit": "registration",
    "locate": "finding the object",
    "extract": "surfaces",
    "label": "labels of the volume",
    "points": "labels of the points",
    "measure": "measuring",
    "write": "writing files",
}
"""What each stage of ``timings_s`` does; another one keeps its name."""

DEVICES = {"cpu": "the processor", "cuda": "the GPU"}
DASH = "\N{EN DASH}"
GAP = 3 * "\N{NO-BREAK SPACE}"
"""For what there is no number of; between coordinates, which have commas at their thousands."""


def confidence_title(calibrated: bool) -> str:
    """Head of a column of confidences."""
    return "confidence" if calibrated else "confidence, not calibrated"


def page_words(summary: Facts, unit: Unit) -> JsonObject:
    """Texts of the page.

    Args:
        summary: as a ``Report`` has it.
        unit: of the lengths in it.

    Returns ``title``, ``trust`` (level, verdict and why), ``facts`` (phrases), ``warnings`` (sentences), ``heads``
    (of the table), ``units`` (of its lengths and volumes), ``rows`` (centre, volume and confidence of each segment;
    confidence is None where there is none), ``joints`` (their values by name), ``weights`` (their name) and
    ``timings_s``, seconds of each stage in words.
    """
    verdict = trust(summary)
    times = {name: _number(seconds) for name, seconds in dict(summary.get("timings_s") or {}).items()}
    return {
        "title": str(summary.get("title", "mereo reconstruction")),
        "trust": [verdict.level, f"{VERDICTS[verdict.level]}:", f"{verdict.why}."],
        "facts": _facts(summary, unit, verdict),
        "warnings": _warnings(summary, verdict),
        "heads": _heads(summary, unit),
        "units": [unit.length_name, unit.volume_name],
        "rows": [_row(segment, unit) for segment in summary.get("segments") or ()],
        "joints": {name: str(joint) for name, joint in stated_joints(summary).items()},
        "weights": str(summary.get("weights") or ""),
        "timings_s": {STAGES.get(name, name): value for name, value in times.items() if value is not None},
    }


def stated_joints(summary: Facts) -> JointValues:
    """Values of the joints that a summary states; none where the object has none."""
    return {
        name: JointValue(
            each["value"], each["interval"] and tuple(each["interval"]), each["unit"], tuple(each["limits"])
        )
        for name, each in summary.get("joints", {}).items()
    }


def joint_table(joints: Mapping[str, JointValue | str]) -> str:
    """HTML of a table of joints with their values, or the words of these; empty without any."""
    cell = '</td><td style="text-align:left;padding-left:1em">'
    rows = (f"<tr><td>{escape(name)}{cell}{escape(str(value))}</td></tr>" for name, value in joints.items())
    head = "<tr><th>joint</th><th>value, 95\N{NO-BREAK SPACE}% range</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>" if joints else ""


def _heads(summary: Facts, unit: Unit) -> list[str]:
    """Heads of the table; with radii of 95 % its centres and volumes say how sure they are."""
    sure = isinstance(summary.get("radius95"), Mapping)
    centre, volume = (", ± 95 %", ", 95 % range") if sure else ("", "")
    heads = [f"centre x, y, z{centre} ({unit.length_name})", f"volume{volume} ({unit.volume_name})"]
    segments = summary.get("segments") or ()
    if not segments or any(_number(segment.get("confidence")) is not None for segment in segments):
        heads.append(confidence_title(summary.get("calibrated") is True))
    return ["segment", *heads]


def _facts(summary: Facts, unit: Unit, verdict: Trust) -> list[str]:
    """Where the answer comes from, how sure it is, and what it was made with."""
    registration, radius95 = summary.get("registration"), summary.get("radius95")
    facts = [_answer(registration, verdict)] if isinstance(registration, Mapping) else []
    source = summary.get("source")
    spacing = _number(summary.get("spacing"))
    if source is not None and str(source) != str(summary.get("title")):
        facts.append(f"from {source}")
    if isinstance(radius95, Mapping):
        facts.append(radius_words(radius95, unit))
    if (expected_iou := _number(_block(summary, "registration").get("expected_iou"))) is not None:
        facts.append(iou_words(expected_iou))
    if spacing is not None:
        facts.append(f"voxels of {rounded(spacing * unit.length_factor)} {unit.length_name}")
    if summary.get("device"):
        facts.append(f"computed on {DEVICES.get(str(summary['device']), str(summary['device']))}")
    return facts


def radius_words(radius95: Facts, unit: Unit) -> str:
    """How far off the surface of a registered model may be, in the words of its ``radius95`` in a summary."""
    middle, most = (f"{rounded(radius95[key] * unit.length_factor)} {unit.length_name}" for key in ("median", "max"))
    level = describe_level(bool(radius95.get("calibrated")))
    return f"its points are within {middle} of their true places in the median, {most} where it is least sure ({level})"


def iou_words(expected_iou: float) -> str:
    """How much of a registered model's volume is expected to be right, in words."""
    return f"its intersection over union with the true object is expected to be {expected_iou:.2f}"


def _answer(registration: Facts, verdict: Trust) -> str:
    explained = _number(registration.get("explained"))
    if explained is None:
        return "the network's own answer"
    ways = {"search": "found by a search", "pose": "fitted from the initial pose"}
    how = ways.get(str(registration.get("located_by")), "registered")
    # a good verdict says itself how much it explains
    share = "" if verdict.level == "yes" else f"{explained:.1%}"
    return f"your model, {how}" + (share and f": it explains {share} of the points")


def _warnings(summary: Facts, verdict: Trust) -> list[str]:
    """Sentences on what to do about a result that may not be what it seems; the verdict itself has said why."""
    warnings = [] if verdict.cure is None else [verdict.cure]
    warnings += [str(sentence) for sentence in _block(summary, "registration").get("symmetries") or ()]
    if summary.get("clipped"):
        warnings.append("the object reaches the border of the volume that was searched and may be cut off there")
    return [text[0].upper() + text[1:] + ("" if text.endswith(".") else ".") for text in warnings]


def _row(segment: Facts, unit: Unit) -> list[Any]:
    centre = segment.get("centroid")
    volume = _number(segment.get("volume"))
    radius = _number(segment.get("centroid_radius95"))
    words = DASH if centre is None or _number(centre[0]) is None else unit.place(np.asarray(centre, float), radius)
    place, sign, off = words.partition(" ± ")
    # a narrow page breaks these lines at their plain spaces
    place = GAP.join(place.split()) + (f"{GAP} ±\N{NO-BREAK SPACE}{off}" if sign else "")
    size = DASH if volume is None else unit.volume(volume, segment.get("volume95"))
    return [place, size, _number(segment.get("confidence"))]


# --- how sure a registered model is -----------------------------------------------------------------------------------

# Bytes for the page: of the surfaces, by their radii, and of the observed points, by what decides each centroid.

UNEXPLAINED = 255
"""Byte of an observed point that the model does not explain; all others are less."""

MOST = 254
"""Byte of the point that decides a centroid most."""

WEIGHTS: SegmentColors = ((150, 156, 168), (40, 120, 255), (255, 176, 0))
"""Colours of observed points from those that decide nothing of a place to those that decide most of it; seen on dark
and on light."""

RED: Color = (229, 40, 50)
"""Colour of unexplained points."""

EVIDENCE = {
    "points": "the points' noise",
    "network": "what the network says",
    "silhouette": "its outline",
    "states": "the states that it can have",
}
"""Each kind of evidence in words."""


def explain_centroids(registered: Registration) -> dict[str, Explanation]:
    """What decides the centroid of each segment; nothing of a registration that was read from a file."""
    return {name: each for name in registered.model.rest.names if (each := registered.explain(name)) is not None}


def point_marks(explanation: Explanation, points: Points) -> Labels:
    """A byte for each observed point: how much it decides a place, 0 to ``MOST``, or that it is ``UNEXPLAINED``.

    The weights are those of the fit's observed samples, which stand for the points around them.
    """
    away, nearest = cKDTree(explanation.points).query(points)
    share = explanation.weights[nearest] / max(float(explanation.weights.max()), np.finfo(np.float64).tiny)
    marks = np.rint(MOST * share).astype(np.uint8)
    if len(explanation.unexplained):
        samples, spacing = explanation.points, np.inf
        if len(samples) > 1:
            spacing = float(np.median(cKDTree(samples).query(samples, k=2)[0][:, 1]))
        lost = cKDTree(explanation.unexplained).query(points)[0]
        marks[(lost <= away) & (lost < spacing)] = UNEXPLAINED
    return marks


def describe_shares(explanation: Explanation) -> str:
    """What leaves a place unsure, in words, largest first."""
    order = sorted(explanation.shares.items(), key=lambda item: -item[1])
    return ", ".join(f"{EVIDENCE[name]} {share:.0%}" for name, share in order if share >= 0.005)


def _radius_bytes(radii: Radii, names: Names, part: Segment) -> str | None:
    """A byte for each vertex, 255 at ``Radii.high``, as base64; None for what is no segment of the model."""
    if part.name not in names or not len(part.vertices):
        return None
    share = radii.at(part.vertices, names.index(part.name) + 1) / max(radii.high, 1e-30)
    return _base64(np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8))


# --- read again -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class WrittenReport:
    """What a page shows besides the surfaces.

    Attributes:
        title: of the page.
        level: of the verdict.
        verdict: the verdict and why, then what to do: sentences.
        joints: values of the object's joints by name, in words.
        cloud: the observed points in the input's frame and unit, to 16 bits of the box of all, as many as are shown.
        count: number of points of the input.
        depth: the depth image as a picture; None without one.
        ends: the nearest and farthest depth in words.
        unit_known: whether the page tells millimetres.
    """

    title: str
    level: Level
    verdict: str
    joints: dict[str, str]
    cloud: PointCloud | None
    count: int
    depth: Picture | None
    ends: Names
    unit_known: bool


def read_report(path: Path) -> WrittenReport | None:
    """What a page shows; None where there is none, or another one (of `mereo evaluate`, of somebody, a damaged one)."""
    if not path.is_file() or path.stat().st_size > 2 * BUDGET_BYTES:
        return None
    _, is_page, rest = path.read_text(encoding="utf-8", errors="replace").partition("const DATA = ")
    text, is_whole, _ = rest.partition(";\n")
    if not is_page or not is_whole:
        return None
    try:
        page = json.loads(text)
        words = page["words"]
        low = np.array(page["low"], float)
        high = np.array(page["high"], float)
        steps = np.frombuffer(base64.b64decode(page["cloud"]["positions"]), "<u2").reshape(-1, 3)
        level, *sentences = words["trust"]
        if level not in VERDICTS:
            return None
        return WrittenReport(
            title=str(words["title"]),
            level=level,
            verdict=" ".join([*sentences, *words["warnings"]]),
            joints={name: str(value) for name, value in words.get("joints", {}).items()},
            cloud=PointCloud(low + steps / STEPS * (high - low)) if len(steps) else None,
            count=int(page["cloud"]["count"]),
            depth=None if page["depth"] is None else _picture(page["depth"]["url"]),
            ends=() if page["depth"] is None else tuple(map(str, page["depth"]["ends"])),
            unit_known=any("mm" in head for head in words["heads"]),
        )
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, RecursionError):
        return None


def _picture(url: str) -> Picture:
    if not url.startswith(PNG_URL):
        raise ValueError("no picture in the page")
    with Image.open(io.BytesIO(base64.b64decode(url.removeprefix(PNG_URL))), formats=("PNG",)) as image:
        if max(image.size) > MOST_DEPTH_PX:
            raise ValueError("a picture that is larger than those of pages")
        return np.asarray(image.convert("RGB"))


# --- in a notebook ----------------------------------------------------------------------------------------------------

SIDES = ("as the camera sees it", "from its right")
"""Of ``CAMERA_VIEWS``: one shows what was seen, the other what was hidden."""

PICTURE_PX = 300


def result_html(
    summary: Facts,
    lines: Sequence[str],
    points: Points,
    surfaces: SegmentedMesh,
    unit: Unit,
) -> str:
    """HTML of a result.

    Args:
        summary: as a ``Report`` has it.
        lines: where the answer comes from.
        points: observed, camera frame.
        surfaces: found, camera frame.
        unit: of the lengths in the summary.
    """
    pictures = points_on_segments(points, surfaces, [CAMERA_VIEWS[name] for name in SIDES], PICTURE_PX)
    shown = np.flatnonzero(np.any([(picture < 255).any(axis=(1, 2)) for picture in pictures], axis=0))
    # rows that are blank in all of them are left out, but for a margin
    rows = slice(max(int(shown[0]) - 8, 0), int(shown[-1]) + 9) if len(shown) else slice(None)
    figures = "".join(
        f'<figure style="margin:0"><img alt="{escape(name)}" src="{data_url(picture[rows])}" width="{PICTURE_PX}">'
        f'<figcaption style="text-align:center;font-size:smaller">{escape(name)}</figcaption></figure>'
        for name, picture in zip(SIDES, pictures, strict=True)
    )
    title = escape(summary["title"])
    text = "<br>".join(escape(line) for line in lines)
    return (
        f'<div><p style="margin:0 0 6px"><b>{title}</b><br>{text}</p>'
        f'<div style="display:flex;gap:8px;flex-wrap:wrap">{figures}</div>'
        f"{_table(summary, surfaces, unit)}{joint_table(stated_joints(summary))}</div>"
    )


def _table(summary: Facts, surfaces: SegmentedMesh, unit: Unit) -> str:
    heads = _heads(summary, unit)
    rows = []
    for segment, (red, green, blue) in zip(summary["segments"], surfaces.colors, strict=True):
        swatch = f'<span style="color:rgb({red},{green},{blue})">&#9632;</span>'
        *lengths, sure = _row(segment, unit)
        values = [*lengths, DASH if sure is None else f"{sure:.2f}"][: len(heads) - 1]
        cells = "".join(f"<td>{value}</td>" for value in values)
        rows.append(f'<tr><td style="text-align:left">{swatch} {escape(segment["name"])}</td>{cells}</tr>')
    head = "".join(f"<th>{name}</th>" for name in heads)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
