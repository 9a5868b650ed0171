"""Result as a notebook shows it: two pictures and a table, without scripts or files."""

from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from mereo.geometry.mesh import SegmentedMesh
from mereo.reconstruction.pipeline import SegmentFacts
from mereo.visualization.contact_sheets import data_url
from mereo.visualization.previews import CAMERA_VIEWS, points_on_segments
from mereo.visualization.report_words import confidence_title
from mereo.visualization.units import Unit

SIDES = ("as the camera sees it", "from its right")
"""Of ``CAMERA_VIEWS``: one shows what was seen, the other what was hidden."""

PICTURE_PX = 300


def result_html(
    title: str,
    lines: Sequence[str],
    points: Float[np.ndarray, "n 3"],
    surfaces: SegmentedMesh,
    segments: Sequence[SegmentFacts],
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
    pictures = points_on_segments(points, surfaces, [CAMERA_VIEWS[name] for name in SIDES], PICTURE_PX)
    shown = np.flatnonzero(np.any([(picture < 255).any(axis=(1, 2)) for picture in pictures], axis=0))
    # rows that are blank in all of them are left out, but for a margin
    rows = slice(max(int(shown[0]) - 8, 0), int(shown[-1]) + 9) if len(shown) else slice(None)
    figures = "".join(
        f'<figure style="margin:0"><img alt="{escape(name)}" src="{data_url(picture[rows])}" width="{PICTURE_PX}">'
        f'<figcaption style="text-align:center;font-size:smaller">{escape(name)}</figcaption></figure>'
        for name, picture in zip(SIDES, pictures, strict=True)
    )
    text = "<br>".join(escape(line) for line in lines)
    return (
        f'<div><p style="margin:0 0 6px"><b>{escape(title)}</b><br>{text}</p>'
        f'<div style="display:flex;gap:8px;flex-wrap:wrap">{figures}</div>'
        f"{_table(segments, surfaces, unit, calibrated)}</div>"
    )


def _table(segments: Sequence[SegmentFacts], surfaces: SegmentedMesh, unit: Unit, calibrated: bool) -> str:
    has_confidence = not all(np.isnan(segment.confidence) for segment in segments)
    sure = [confidence_title(calibrated)] if has_confidence else []
    heads = ("segment", f"volume, {unit.volume_name}", *sure, f"centre, {unit.length_name}")
    rows = []
    for segment, (red, green, blue) in zip(segments, surfaces.colors, strict=True):
        swatch = f'<span style="color:rgb({red},{green},{blue})">&#9632;</span>'
        confidence = [f"{segment.confidence:.2f}"] if has_confidence else []
        values = (unit.volume(segment.volume), *confidence, unit.place(segment.centroid))
        cells = "".join(f"<td>{value}</td>" for value in (values if segment.voxels else ("0", "not found", "")))
        rows.append(f'<tr><td style="text-align:left">{swatch} {escape(segment.name)}</td>{cells}</tr>')
    head = "".join(f"<th>{name}</th>" for name in heads)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
