"""What a notebook shows of a result: two pictures and a table, without scripts or files."""

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float
from PIL import Image

from mereo.geometry.mesh import SegmentedMesh
from mereo.reconstruction.pipeline import FoundSegment
from mereo.visualization.contact_sheets import Picture
from mereo.visualization.previews import CAMERA_VIEWS, seen_on_found
from mereo.visualization.report_words import confidence_title
from mereo.visualization.units import Unit

SIDES = ("as the camera sees it", "from its right")
"""Of ``CAMERA_VIEWS``: one shows what was seen, the other what was hidden."""

PICTURE_PX = 300

MARGIN_PX = 8

COLORS = 96
"""Colours of a picture, which make it a quarter as large."""


def result_html(
    title: str,
    lines: Sequence[str],
    points: Float[np.ndarray, "n 3"],
    surfaces: SegmentedMesh,
    segments: Sequence[FoundSegment],
    unit: Unit,
    calibrated: bool = False,
) -> str:
    """HTML of a result.

    Args:
        title: what was seen.
        lines: where the answer comes from.
        points: observed, camera frame.
        surfaces: found, camera frame.
        segments: in figures, in the frame of the input.
        unit: of these.
        calibrated: whether their confidences are.
    """
    views = {name: CAMERA_VIEWS[name] for name in SIDES}
    pictures = zip(views, _cropped(seen_on_found(points, surfaces, list(views.values()), PICTURE_PX)), strict=True)
    told = "<br>".join(escape(line) for line in lines)
    figures = "".join(
        f'<figure style="margin:0"><img alt="{escape(name)}" src="{data_url(picture)}" width="{PICTURE_PX}">'
        f'<figcaption style="text-align:center;font-size:smaller">{escape(name)}</figcaption></figure>'
        for name, picture in pictures
    )
    table = _table(segments, surfaces, unit, calibrated)
    return (
        f'<div><p style="margin:0 0 6px"><b>{escape(title)}</b><br>{told}</p>'
        f'<div style="display:flex;gap:8px;flex-wrap:wrap">{figures}</div>{table}</div>'
    )


def _cropped(pictures: Sequence[Picture]) -> list[Picture]:
    """The pictures without the rows that are blank in all of them."""
    shown = np.flatnonzero(np.any([(picture < 255).any(axis=(1, 2)) for picture in pictures], axis=0))
    rows = slice(max(int(shown[0]) - MARGIN_PX, 0), int(shown[-1]) + 1 + MARGIN_PX) if len(shown) else slice(None)
    return [picture[rows] for picture in pictures]


def _table(segments: Sequence[FoundSegment], surfaces: SegmentedMesh, unit: Unit, calibrated: bool) -> str:
    known = not all(np.isnan(found.confidence) for found in segments)
    sure = [confidence_title(calibrated)] if known else []
    heads = ("segment", f"volume, {unit.volume_name}", *sure, f"centre, {unit.length_name}")
    rows = []
    for found, (red, green, blue) in zip(segments, surfaces.colors, strict=True):
        swatch = f'<span style="color:rgb({red},{green},{blue})">&#9632;</span>'
        told = [f"{found.confidence:.2f}"] if known else []
        values = (unit.volume(found.volume), *told, unit.place(found.centroid))
        cells = "".join(f"<td>{value}</td>" for value in (values if found.voxels else ("0", "not found", "")))
        rows.append(f'<tr><td style="text-align:left">{swatch} {escape(found.name)}</td>{cells}</tr>')
    head = "".join(f"<th>{name}</th>" for name in heads)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def data_url(picture: Picture) -> str:
    """Picture as an address that holds it."""
    kept = io.BytesIO()
    Image.fromarray(picture).quantize(COLORS, dither=Image.Dither.NONE).save(kept, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(kept.getvalue()).decode('ascii')}"
