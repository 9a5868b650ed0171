"""Small pieces of HTML for the panels; every text from outside is escaped."""

from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from mereo.evaluation.metrics import Scores, format_score
from mereo.geometry.mesh import Color
from mereo.visualization.units import Unit, rounded
from mereo.visualization.vertex_colors import ColorScale
from mereo.visualization.viewer.probe import ON_SURFACE, Probed

SOFT = "opacity:.62"

BOX = "padding:2px 0.9em 6px;font-size:0.82em;line-height:1.5"


def css(color: Color) -> str:
    """Colour as CSS writes it."""
    return "rgb({},{},{})".format(*color)


def heading(title: str, text: str) -> str:
    """Heading of a panel: what the page is about."""
    return (
        f'<div style="padding:6px 0.75em 4px"><div style="font-weight:650;font-size:1.05em">{escape(title)}</div>'
        f'<div style="font-size:0.8em;{SOFT}">{escape(text)}</div></div>'
    )


def message(text: str, bad: bool = False) -> str:
    """Line on what is going on; "" is an empty line, so that nothing jumps."""
    color = "color:#e5484d" if bad else SOFT
    return f'<div style="{BOX};min-height:1.9em;{color}">{escape(text) or "&nbsp;"}</div>'


def chips(names: Sequence[str], colors: Sequence[Color]) -> str:
    """Chips that name the segments' colours."""
    each = "".join(
        f'<span style="white-space:nowrap;margin-right:11px"><span style="display:inline-block;width:10px;height:10px;'
        f'border-radius:3px;background:{css(color)};margin-right:5px"></span>{escape(name)}</span> '
        for name, color in zip(names, colors, strict=True)
    )
    return f'<div style="{BOX}">{each}</div>'


def color_bar(scale: ColorScale) -> str:
    """Bar with all colours of a scale, and what its ends mean."""
    stops = ",".join(css(color) for color in scale.stops)
    return (
        f'<div style="{BOX}"><div>{escape(scale.title)}</div><div style="height:9px;border-radius:5px;margin:3px 0;'
        f'background:linear-gradient(90deg,{stops})"></div><div style="display:flex;justify-content:space-between;'
        f'{SOFT}"><span>{escape(scale.words[0])}</span><span>{escape(scale.words[1])}</span></div></div>'
    )


def bars(rows: Sequence[tuple[str, Color, float]]) -> str:
    """Bars that show named numbers from 0 to 1; NaN is a dash."""
    cells = "".join(
        f"<div>{escape(name)}</div>"
        f'<div style="background:rgba(128,128,128,.22);border-radius:4px;height:7px;align-self:center"><div style="'
        f"width:{0 if np.isnan(value) else 100 * min(max(value, 0.0), 1.0):.1f}%;height:7px;border-radius:4px;"
        f'background:{css(color)}"></div></div>'
        f'<div style="text-align:right">{"–" if np.isnan(value) else f"{value:.2f}"}</div>'
        for name, color, value in rows
    )
    grid = "display:grid;grid-template-columns:minmax(4.5em,auto) 1fr 2.4em;gap:1px 9px"
    return f'<div style="{BOX};font-variant-numeric:tabular-nums;{grid}">{cells}</div>'


def scores(found: Scores, names: Sequence[str], colors: Sequence[Color]) -> str:
    """Scores: IoU and mIoU large, each segment below."""
    big = "".join(
        f'<div><div style="font-size:2.1em;font-weight:650;line-height:1.15">{format_score(value, "–")}</div>'
        f'<div style="{SOFT}">{label}</div></div>'
        for label, value in (("IoU, whole object", found.iou), ("mIoU, segments", found.miou))
    )
    head = f'<div style="{BOX};display:flex;gap:2em;font-variant-numeric:tabular-nums">{big}</div>'
    rows = [(name, color, float(value)) for name, color, value in zip(names, colors, found.per_segment, strict=True)]
    return head + bars(rows)


def answer(
    found: Probed, names: Sequence[str], colors: Sequence[Color], place: Float[np.ndarray, "3"], unit: Unit
) -> str:
    """Facts about one place: its segment, the network's likeliest classes, distance, direction, and where it rests."""
    label, distance, direction = int(found.label[0]), float(found.distance[0]), found.direction[0]
    side = "inside" if distance < 0 else "outside"
    said = (
        "distance not trained" if np.isnan(distance) else _length(abs(distance), unit) + f" {side} the nearest surface"
    )
    if abs(distance) <= ON_SURFACE * float(np.abs(place).max()):
        said = "on the surface"
    toward = "" if np.isnan(direction).any() else f"towards {_vector(direction.tolist())}"
    rest = "" if found.rest is None else f"<br>at rest at {_vector(found.rest[0].tolist())} scene units"
    radius = None if found.radius95 is None else float(found.radius95[0])
    where = f"at {unit.place(place, radius)} {unit.length_name}" + (
        "" if radius is None else " (95\N{NO-BREAK SPACE}%)"
    )
    return (
        f'<div style="{BOX}"><b>{escape(names[label])}</b> <span style="{SOFT}">{where}</span></div>'
        f'{_likeliest(found, names, colors)}<div style="{BOX}">{escape(said)}<br><span style="{SOFT}">{toward}{rest}'
        "</span></div>"
    )


def _likeliest(found: Probed, names: Sequence[str], colors: Sequence[Color]) -> str:
    """Bars of the network's likeliest classes at one place; nothing where it was not asked."""
    if found.probability is None:
        return ""
    order = np.argsort(-found.probability[0], kind="stable")[:4]
    shown = bars([(names[k], colors[k], float(found.probability[0, k])) for k in order])
    return shown if found.rest is None else f'<div style="{BOX};{SOFT}">the network says</div>{shown}'


def _length(value: float, unit: Unit) -> str:
    """Length of the input's frame, with its unit."""
    return f"{rounded(value * unit.length_factor)} {unit.length_name}"


def _vector(values: Sequence[float]) -> str:
    return ", ".join(f"{float(value):.3g}" for value in values)
