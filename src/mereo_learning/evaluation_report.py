"""Folders of results that ``mereo evaluate`` leaves: metrics.json, table.md, errors.png and ``report.html``.

The page has the scores of a test set and its error picture: plain HTML with its style inside, no script, nothing from
outside.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from PIL import Image

from mereo.geometry.mesh import Color
from mereo.geometry.metrics import format_score
from mereo.io.atomic_files import new_directory, write_file, write_json
from mereo.io.config import CONFIG
from mereo.models.config import EXACT, InferenceConfig
from mereo.models.model import Model
from mereo.models.weights import load_for, settings_for
from mereo.scenes.registry import files_of
from mereo.scenes.scene import Scene
from mereo.visualization.reconstruction_report import BUDGET_BYTES
from mereo.workers.spread import Cluster
from mereo_learning.cases import Evaluation
from mereo_learning.error_maps import error_picture
from mereo_learning.scoring import EvaluationConfig, evaluate, trained_scene
from mereo_learning.tables import certainty_lines, markdown_table, metrics


def evaluate_weights(
    weights: Model | str | Path,
    output: str | Path,
    config: EvaluationConfig,
    *,
    inference: InferenceConfig = EXACT,
    workers: int | Cluster = 1,
    force: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Score weights, write metrics.json, table.md, errors.png, report.html, and print the table: ``mereo evaluate``.

    With ``force`` an existing folder that mereo wrote is replaced; ``options`` are written to config.json.
    Each view is a task of a cluster, where ``workers`` is one.
    """
    scene = config.scene
    read = [*([] if isinstance(weights, Model) else [weights]), *(config.scans or ())]
    with new_directory(output, force, [*read, *(files_of(scene) if isinstance(scene, str) else [])]) as directory:
        model = weights if isinstance(weights, Model) else load_for(weights, settings_for(inference, workers))
        evaluation = evaluate(model, config, progress=True, workers=workers)
        if config.scans is not None:
            facts: dict[str, Any] = {"scans": list(evaluation.examples), "truths": [str(path) for path in config.scans]}
        else:
            facts = {
                "weights": model.name if isinstance(weights, Model) else str(weights),
                "scene": scene.name if isinstance(scene, Scene) else scene or trained_scene(model),
                "seed": config.seed,
                "image_size": config.settings.image_size,
                "noise_std": config.settings.noise_std,
                "sensor": asdict(config.settings.sensor),
                "workspace": config.settings.workspace,
                "device": workers.device if isinstance(workers, Cluster) else model.device.type,
                "precision": model.working_precision,
            }
        values = metrics(evaluation, {**facts, "trained": model.provenance})
        picture = directory / "errors.png"
        if options is not None:
            write_json(directory / CONFIG, options)
        write_json(directory / "metrics.json", values)
        (directory / "table.md").write_text(markdown_table(evaluation), encoding="utf-8")
        error_picture(picture, evaluation.views)
        write_evaluation_report(directory / "report.html", values, evaluation.views[0].colors, picture)
    print(markdown_table(evaluation))
    print(f"wrote {output}")
    return evaluation


# --- page -------------------------------------------------------------------------------------------------------------

STYLE = """
:root { color-scheme: light dark; --bg: #f6f7f9; --card: #fff; --ink: #1d2430; --soft: #667085; --line: #e3e6ec; --accent: 37 99 201; }
@media (prefers-color-scheme: dark) { :root { --bg: #12151b; --card: #1a1f28; --ink: #e8ebf1; --soft: #98a2b3; --line: #2b323f; --accent: 127 176 255; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 24px 20px 40px; }
h1 { font-size: 24px; line-height: 1.25; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 12px; font-weight: 650; margin: 0 0 10px; color: var(--soft); letter-spacing: .06em; text-transform: uppercase; }
p { margin: 0 0 18px; color: var(--soft); overflow-wrap: anywhere; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 14px; padding: 16px; margin-bottom: 16px; overflow-x: auto; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 16px; }
section p:last-child { margin-bottom: 0; }
.big { display: grid; grid-template-columns: repeat(auto-fit, minmax(130px, max-content)); gap: 12px 44px; } .big b { display: block; font-size: 34px; line-height: 1.15; font-weight: 650; }
.big span, th { color: var(--soft); font-weight: 500; font-size: 13px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 5px 10px; white-space: nowrap; } td { border-top: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.swatch { width: 14px; height: 14px; border-radius: 4px; display: inline-block; margin-right: 9px; vertical-align: -2px; }
.bar { display: inline-block; width: 120px; height: 6px; border-radius: 3px; background: var(--line); margin-right: 8px; vertical-align: 2px; overflow: hidden; }
.bar i { display: block; height: 100%; background: rgb(var(--accent)); }
.long { max-height: 360px; overflow: auto; } .cm td { text-align: center; } .cm td:first-child { text-align: left; }
img { width: 100%; border-radius: 8px; background: #fff; display: block; }
.rel { width: min(100%, 320px); } .rel rect { fill: none; stroke: var(--line); } .rel line { stroke: var(--soft); stroke-dasharray: 5 5; }
.rel polyline { fill: none; stroke: rgb(var(--accent)); stroke-width: 2; } .rel circle { fill: rgb(var(--accent) / .45); }
.rel text { fill: var(--soft); font-size: 11px; } .rel .m { text-anchor: middle; } .rel .e { text-anchor: end; }
footer { color: var(--soft); font-size: 13px; }
@media (max-width: 560px) { main { padding: 16px 10px 30px; } .bar { width: 56px; } th, td { padding: 5px 6px; } }
"""  # noqa: E501 (lines of CSS)

DASH = "–"
"""Mark of a score that is undefined."""


def write_evaluation_report(
    path: str | Path, metrics: Mapping[str, Any], colors: Sequence[Color], picture: str | Path
) -> None:
    """Write the page of an evaluation's scores.

    Args:
        path: the .html file.
        metrics: what ``metrics.json`` holds, see ``scoring.metrics``; NaN is shown as a dash.
        colors: colours of the segments.
        picture: a PNG file, which the page has as a JPEG, made smaller until it fits into ``BUDGET_BYTES``.
    """
    names = tuple(metrics["per_segment"])
    mean = metrics["example_mean"]
    title = " on ".join(str(metrics[key]) for key in ("weights", "scene") if key in metrics) or "mereo evaluation"
    below = {"iou", "miou", "definition", "ece", "calibrated"}
    facts = {k: v for k, v in metrics.items() if isinstance(v, str | int | float) and k not in below}
    shown = [f"{key.replace('_', ' ')}: {value}" for key, value in facts.items()]
    scores = {"IoU, whole set": metrics["iou"], "mIoU, whole set": metrics["miou"]}
    scores |= {"IoU, mean over examples": mean["iou"], "mIoU, mean over examples": mean["miou"]}
    overall = "".join(
        f"<div><b>{format_score(value, DASH)}</b><span>{title}</span></div>" for title, value in scores.items()
    )
    # how often true positions lie within a registration's radii, and frames are said to show the object
    sure = "".join(f"<p>{escape(line)}</p>" for line in certainty_lines(metrics))
    text = "".join(
        (
            f"<h1>{escape(title)}</h1>",
            f"<p>{escape('  ·  '.join(shown))}</p>",
            f'<section><div class="big">{overall}</div></section>',
            f"<section><h2>How sure</h2>{sure}</section>" if sure else "",
            f'<div class="pair">{_segments(metrics["per_segment"], colors)}{_examples(metrics["per_example"])}</div>',
            _confusion(("empty", *names), metrics["confusion"]),
            _reliability(metrics.get("reliability") or [], metrics.get("ece"), metrics.get("calibrated") is True),
        )
    )
    words = escape(str(metrics.get("definition", "")))
    room = BUDGET_BYTES - len(text.encode()) - len(STYLE) - len(words) - 2000
    encoded = io.BytesIO()
    with Image.open(picture) as image:
        small = image.convert("RGB")
    small.save(encoded, "JPEG", quality=85)
    while len(encoded.getvalue()) > room * 3 // 4 and min(small.size) > 16:
        small = small.resize((max(1, small.width * 3 // 4), max(1, small.height * 3 // 4)))
        encoded = io.BytesIO()
        small.save(encoded, "JPEG", quality=85)
    data = base64.b64encode(encoded.getvalue()).decode("ascii")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body><main>{text}"
        '<section><h2>Errors of the first examples</h2><img alt="clouds, reconstructions, errors and references" '
        f'src="data:image/jpeg;base64,{data}"></section><footer>Made by mereo: {words}.</footer></main></body>'
        "</html>\n"
    ).encode("utf-8", errors="replace")
    write_file(path, page)


def _segments(per_segment: Mapping[str, float], colors: Sequence[Color]) -> str:
    rows = "".join(
        f'<tr><td><span class="swatch" style="background:rgb{tuple(color)}"></span>{escape(name)}</td>'
        f"<td>{_bar(value)}</td></tr>"
        for (name, value), color in zip(per_segment.items(), colors, strict=True)
    )
    return f"<section><h2>Segments</h2><table><tr><th>segment</th><th>IoU</th></tr>{rows}</table></section>"


def _confusion(classes: Sequence[str], confusion: Int[np.ndarray, "c c"]) -> str:
    """Shares of each true class, so that rows add up to 100 %."""
    shares = confusion / np.maximum(confusion.sum(axis=1, keepdims=True), 1)
    head = "".join(f"<th>{escape(name)}</th>" for name in classes)
    rows = "".join(
        f"<tr><td>{escape(name)}</td>"
        + "".join(
            f'<td style="background:rgb(var(--accent) / {0.7 * share:.3f})">{_percent(share)}</td>' for share in row
        )
        + f"<td>{count:,}</td></tr>"
        for name, row, count in zip(classes, shares, confusion.sum(axis=1), strict=True)
    )
    title = "<h2>Confusion: rows are the true class, columns the predicted one, % of the true class</h2>"
    return f'<section class="cm">{title}<table><tr><th></th>{head}<th>points</th></tr>{rows}</table></section>'


def _reliability(bins: Sequence[Mapping[str, float]], ece: float | None, calibrated: bool) -> str:
    """Reliability diagram of the network's probabilities: share of right answers over confidence, and the diagonal."""
    if not bins:
        return ""
    side, foot, middle = 260, 274, 130
    axes = (
        f'<text y="{foot}">0</text><text class="e" x="{side}" y="{foot}">1</text>'
        f'<text class="m" x="{middle}" y="{foot + 14}">confidence in a cell\'s label</text>'
        f'<text class="e" x="-5" y="{side}">0</text><text class="e" x="-5" y="9">1</text>'
        f'<text class="m" transform="translate(-18 {middle}) rotate(-90)">share that is right</text>'
    )
    points = " ".join(f"{side * b['confidence']:.1f},{side * (1 - b['right']):.1f}" for b in bins)
    dots = "".join(
        f'<circle cx="{side * b["confidence"]:.1f}" cy="{side * (1 - b["right"]):.1f}" '
        f'r="{2 + 8 * b["share"] ** 0.5:.1f}"><title>{_percent(b["share"])} % of the cells: confidence '
        f"{b['confidence']:.2f}, right {b['right']:.2f}</title></circle>"
        for b in bins
    )
    svg = (
        f'<svg class="rel" viewBox="-34 -12 {side + 46} {side + 46}" role="img" '
        f'aria-label="share of right answers over confidence"><rect width="{side}" height="{side}"/>'
        f'<line x1="0" y1="{side}" x2="{side}" y2="0"/>'
        f'<polyline points="{points}"/>{dots}{axes}</svg>'
    )
    kind = "calibrated" if calibrated else "not calibrated"
    return (
        f"<section><h2>Reliability of the network's probabilities ({kind})</h2><p>Expected calibration error "
        f"{format_score(ece, DASH)}. A point's size: how many cells. On "
        f"the diagonal the network is as often right as it says.</p>{svg}</section>"
    )


def _examples(per_example: Mapping[str, Mapping[str, float]]) -> str:
    """Worst first: those are what one looks for."""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{_bar(each['iou'])}</td><td>{_bar(each['miou'])}</td></tr>"
        for name, each in sorted(per_example.items(), key=lambda item: item[1]["iou"])
    )
    head = "<tr><th>example</th><th>IoU</th><th>mIoU</th></tr>"
    return f'<section><h2>Examples, worst first</h2><div class="long"><table>{head}{rows}</table></div></section>'


def _bar(value: float) -> str:
    width = 0.0 if np.isnan(value) else 100 * value
    return f'<span class="bar"><i style="width:{width:.0f}%"></i></span>{format_score(value, DASH)}'


def _percent(share: float) -> str:
    return "·" if share < 0.0005 else f"{100 * share:.1f}"
