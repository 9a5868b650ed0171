"""What ``report.html`` of a result shows, read from it again: its points, its depth image, its verdict.

    report.html -read_report-> WrittenReport

A folder of results has its surfaces in files of their own; what was observed is in the page alone, whose data are one
line of JSON (``reconstruction_report``). They are read as data; no script is run.
"""

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from PIL import Image
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from mereo.geometry.camera import PointCloud
from mereo.visualization.contact_sheets import Picture
from mereo.visualization.depth_picture import MOST_SIDE
from mereo.visualization.reconstruction_report import BUDGET_BYTES, STEPS
from mereo.visualization.trust import Level

REPORT = "report.html"
"""Name of the page in a folder of results."""

START, END = "const DATA = ", ";\n"
PNG = "data:image/png;base64,"

Place = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]


class _Cloud(BaseModel):
    count: Annotated[int, Field(ge=0)]
    positions: str


class _Depth(BaseModel):
    url: str
    ends: Annotated[tuple[str, ...], Field(max_length=2)]


class _Words(BaseModel):
    title: str
    trust: tuple[Level, str, str] | None = None
    warnings: tuple[str, ...] = ()
    heads: tuple[str, ...] = ()


class _Page(BaseModel):
    low: Place
    high: Place
    cloud: _Cloud
    words: _Words
    depth: _Depth | None = None


@dataclass(frozen=True, eq=False)
class WrittenReport:
    """What a page shows beside the surfaces.

    Attributes:
        title: of the page.
        level: of the verdict; None for a page without one.
        verdict: the verdict and why, then what to do: sentences.
        cloud: the observed points in the input's frame and unit, to 16 bits of the box of all, as many as are shown.
        count: number of points of the input.
        depth: the depth image as a picture; None without one.
        ends: the nearest and farthest depth in words.
        unit_known: whether the page tells millimetres.
    """

    title: str
    level: Level | None
    verdict: str
    cloud: PointCloud | None
    count: int
    depth: Picture | None
    ends: tuple[str, ...]
    unit_known: bool


def read_report(path: Path) -> WrittenReport | None:
    """What a page shows; None where there is none, or another one (of `mereo evaluate`, of somebody, a damaged one)."""
    if not path.is_file() or path.stat().st_size > 2 * BUDGET_BYTES:
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    start = text.find(START) + len(START)
    end = text.find(END, start)
    if start < len(START) or end < 0:
        return None
    try:
        page = _Page.model_validate(json.loads(text[start:end]))
        points = _positions(page.cloud.positions, np.array(page.low), np.array(page.high))
        depth = None if page.depth is None else _picture(page.depth.url)
    except (ValidationError, ValueError, OSError, RecursionError):
        return None
    words, told = page.words, page.words.trust
    return WrittenReport(
        title=words.title,
        level=None if told is None else told[0],
        verdict="" if told is None else " ".join([*told[1:], *words.warnings]),
        cloud=PointCloud(points) if len(points) else None,
        count=page.cloud.count,
        depth=depth,
        ends=() if page.depth is None else page.depth.ends,
        unit_known=any("mm" in head for head in words.heads),
    )


def _positions(text: str, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    steps = np.frombuffer(base64.b64decode(text), "<u2").reshape(-1, 3)
    result: Float[np.ndarray, "n 3"] = low + steps / STEPS * (high - low)
    return result


def _picture(url: str) -> Picture:
    kind: Literal["PNG"] = "PNG"
    if not url.startswith(PNG):
        raise ValueError("no picture in the page")
    with Image.open(io.BytesIO(base64.b64decode(url.removeprefix(PNG))), formats=(kind,)) as image:
        if max(image.size) > MOST_SIDE:
            raise ValueError("a picture that is larger than those of pages")
        return np.asarray(image.convert("RGB"))
