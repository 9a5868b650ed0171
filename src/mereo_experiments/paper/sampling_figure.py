"""Figure of the paper's samplers: where each sampler puts its points on three toy shapes in two dimensions.

The samplers of ``mereo.synthesis.query_sampling`` ask an object five things (``Shape``); ``Polygons2D`` shows how
little it takes to make one. The outlines are in ``toy2d.json``, with the square from which the paper draws candidates.
"""

import json
from collections.abc import Callable
from importlib import resources

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure

from mereo.synthesis.query_sampling import Samples, label_uniform, sort_sample, volume_uniform

KEEP = 256
"""Number of points on each side of the surface, the k of the paper's figure."""

Polygon = Float[np.ndarray, "v 2"]


class Polygons2D:
    """Object whose segments are simple polygons, corners in order, either way round: a ``label_rules.Shape``."""

    nesting: tuple[tuple[int, int], ...] = ()

    def __init__(self, *outlines: Polygon) -> None:
        self.outlines = outlines
        self.count = len(outlines)

    def boxes(self) -> Float[np.ndarray, "s 2 2"]:
        """Lower and upper corner of each segment's box."""
        return np.stack([[outline.min(axis=0), outline.max(axis=0)] for outline in self.outlines])

    def inside(self, index: int, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether points lie in a segment: a ray to the right crosses its outline an odd number of times."""
        start, edge = _edges(self.outlines[index])
        x, y = points[:, :1], points[:, 1:]
        spans = (start[:, 1] > y) != (start[:, 1] + edge[:, 1] > y)
        # the crossing's side by the sign of a product, so that level edges divide by nothing
        right = (edge[:, 0] * (y - start[:, 1]) - edge[:, 1] * (x - start[:, 0])) * np.sign(edge[:, 1]) > 0
        return (spans & right).sum(axis=1) % 2 == 1

    def label(self, points: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, " n"]:
        """Label of each point: 0 in empty space, else index + 1 of the first segment that holds it."""
        labels = np.zeros(len(points), dtype=np.uint8)
        for index in reversed(range(self.count)):
            labels[self.inside(index, points)] = index + 1
        return labels

    def segment_distance(self, index: int, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Distance of each point to the outline of a segment."""
        start, edge = _edges(self.outlines[index])
        offset = points[:, None] - start
        along = np.clip((offset * edge).sum(axis=2) / (edge**2).sum(axis=1), 0, 1)
        return np.linalg.norm(offset - along[..., None] * edge, axis=2).min(axis=1)


def _edges(outline: Polygon) -> tuple[Polygon, Polygon]:
    return outline, np.roll(outline, -1, axis=0) - outline


def read_outlines() -> tuple[dict[str, Polygon], Float[np.ndarray, "2 2"]]:
    """Outlines of the toy shapes by name, and the square from which the figure's candidates are drawn."""
    data = json.loads(resources.files("mereo_experiments.paper").joinpath("toy2d.json").read_text("utf-8"))
    return {name: np.array(corners) for name, corners in data["shapes"].items()}, np.array(data["candidates_box"])


Boxes = Float[np.ndarray, "s 2 2"]
SAMPLERS: dict[str, Callable[[Polygons2D, np.random.Generator, Boxes], Samples]] = {
    "Volume Uniform": lambda shape, rng, boxes: volume_uniform(shape, 2 * KEEP, rng, boxes),
    "Label Uniform": lambda shape, rng, boxes: label_uniform(shape, KEEP, rng, boxes),
    "SortSample, n = k": lambda shape, rng, boxes: sort_sample(shape, KEEP, KEEP, rng, boxes),
    "SortSample, n = 2k": lambda shape, rng, boxes: sort_sample(shape, KEEP, 2 * KEEP, rng, boxes),
}
"""Samplers of the figure's rows by their titles."""


def _gradient(name: str) -> Colormap:
    """A sequential map from its dark end, at the surface, to a middle tone that still shows on white."""
    return ListedColormap(matplotlib.colormaps[name](np.linspace(0.95, 0.4, 256)))


INSIDE, OUTSIDE = _gradient("YlOrRd"), _gradient("GnBu")
DISTANCE = Normalize(0.0, 0.6, clip=True)


def draw_panel(axes: Axes, shape: Polygons2D, samples: Samples) -> None:
    """Draw points coloured by side and by distance to the surface, over the outline, and their numbers below."""
    for outline in shape.outlines:
        axes.fill(*outline.T, facecolor="0.955", edgecolor="0.25", linewidth=0.9, zorder=1)
    inside = samples.labels > 0
    for colors, points in ((OUTSIDE, samples.points[~inside]), (INSIDE, samples.points[inside])):
        distance = shape.segment_distance(0, points)
        axes.scatter(points[:, 0], points[:, 1], s=4.5, c=distance, cmap=colors, norm=DISTANCE, linewidths=0, zorder=2)
    axes.set(xlim=(0, 2.25), ylim=(0, 2.25), xticks=[], yticks=[], aspect="equal")
    axes.set_xlabel(f"{inside.sum()} inside, {(~inside).sum()} outside", fontsize=7.5, color="0.3", labelpad=2)


def draw_bar(axes: Axes, colors: Colormap, side: str) -> None:
    """Draw what the gradient of one side means."""
    mappable = ScalarMappable(DISTANCE, colors)
    bar = Colorbar(axes, mappable, orientation="horizontal", extend="max" if side == "outside" else "neither")
    bar.set_label(f"{side}, distance to the outline", fontsize=8)
    axes.tick_params(labelsize=7)


def draw_figure(rng: np.random.Generator) -> Figure:
    """Figure with a row per sampler and a column per shape, as in the paper, and both gradients explained below."""
    outlines, box = read_outlines()
    figure = Figure(figsize=(6.6, 9.6))
    rows = figure.add_gridspec(2, 1, height_ratios=(60, 1), hspace=0.1, left=0.05, right=0.98, bottom=0.05, top=0.97)
    grid = rows[0].subgridspec(len(SAMPLERS), len(outlines), wspace=0.06, hspace=0.12).subplots(squeeze=False)
    for row, (title, sampler) in zip(grid, SAMPLERS.items(), strict=True):
        row[0].set_ylabel(title, fontsize=10)
        for axes, outline in zip(row, outlines.values(), strict=True):
            shape = Polygons2D(outline)
            draw_panel(axes, shape, sampler(shape, rng, box[None]))
    for axes, name in zip(grid[0], outlines, strict=True):
        axes.set_title(name, fontsize=10)
    left, right = rows[1].subgridspec(1, 2).subplots(squeeze=False)[0]
    draw_bar(left, INSIDE, "inside")
    draw_bar(right, OUTSIDE, "outside")
    return figure
