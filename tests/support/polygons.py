"""Polygons in the plane as an object that query points are drawn around."""

import numpy as np
from jaxtyping import Bool, Float, UInt8

Polygon = Float[np.ndarray, "v 2"]


class Polygons2D:
    """Object whose segments are simple polygons, corners in order, either way round: a ``query_sampling.Shape``."""

    nesting: tuple[tuple[int, int], ...] = ()

    def __init__(self, *outlines: Polygon) -> None:
        self.outlines, self.count = outlines, len(outlines)

    def boxes(self) -> Float[np.ndarray, "s 2 2"]:
        return np.stack([[outline.min(axis=0), outline.max(axis=0)] for outline in self.outlines])

    def inside(self, index: int, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """A ray to the right crosses the outline an odd number of times."""
        start = self.outlines[index]
        edge, x, y = np.roll(start, -1, axis=0) - start, points[:, :1], points[:, 1:]
        spans = (start[:, 1] > y) != (start[:, 1] + edge[:, 1] > y)
        # the crossing's side by the sign of a product, so that level edges divide by nothing
        right = (edge[:, 0] * (y - start[:, 1]) - edge[:, 1] * (x - start[:, 0])) * np.sign(edge[:, 1]) > 0
        return (spans & right).sum(axis=1) % 2 == 1

    def label(self, points: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, " n"]:
        labels = np.zeros(len(points), dtype=np.uint8)
        for index in reversed(range(self.count)):
            labels[self.inside(index, points)] = index + 1
        return labels

    def segment_distance(self, index: int, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        start = self.outlines[index]
        edge, offset = np.roll(start, -1, axis=0) - start, points[:, None] - start
        along = np.clip((offset * edge).sum(axis=2) / (edge**2).sum(axis=1), 0, 1)
        return np.linalg.norm(offset - along[..., None] * edge, axis=2).min(axis=1)
