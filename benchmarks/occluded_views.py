"""Views in which something hides a part of the object, or the picture's edge cuts it, before a far wall.

    View -occlude-> OccludedView: the whole depth image, the object's mask, and the truth

For trials of registration where the object's outline is not its silhouette. The truth is the mesh of the view, and the
depth image that the same camera would take of the object alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Hits, Solids
from mereo.io.sensor_frame import SensorFrame
from mereo.synthesis.clutter import OBJECT, Backdrop, Capsule, Surroundings, farthest, sample_occluder
from mereo.synthesis.config import GenerateConfig, Occluder
from mereo.synthesis.depth_sensor import observe, render_depth
from mereo.synthesis.examples import View

Cut = Literal["none", "screen", "picture", "tool", "hand"]
"""What hides a part of the object: nothing, an occluder with a straight edge, the picture's edge, a tool, a hand."""

PLACES = 24
"""Random positions of a tool or hand, of which the one that hides nearest to the wanted share is taken."""

NEARER = 0.95
"""Depth of a screen, as a share of the object's least depth."""

WALL_SIZES = 1.5
"""Distance between the object and the wall behind it, in longest sides of the object."""


class Occluding(Protocol):
    """What a ray may meet before the object."""

    def first_hit(self, directions: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " m"], Hits]:
        """Rows of the rays from the origin that hit it, and where."""


@dataclass(frozen=True, eq=False)
class Screen:
    """Flat occluder with one straight edge: all points of a depth whose slope (x/z, y/z) along an axis is small enough.

    Attributes:
        depth: z of its points.
        axis: unit vector in the image plane, across the edge.
        limit: largest slope along the axis.
    """

    depth: float
    axis: Float[np.ndarray, "2"]
    limit: float

    def first_hit(self, directions: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " m"], Hits]:
        """Rows of the rays from the origin that hit the screen, and where."""
        slope = directions[:, :2] / directions[:, 2:]
        rows = np.flatnonzero(slope @ self.axis <= self.limit)
        return rows, Hits(self.depth / directions[rows, 2], np.tile([0.0, 0.0, 1.0], (len(rows), 1)))


@dataclass(frozen=True, eq=False)
class OccludedView:
    """View of an object of which a part is hidden or outside the picture, in the camera frame and scene units.

    Attributes:
        mesh: the object's segments.
        whole: all that was measured, with occluder and wall.
        mask: pixels of the object, as the sensor's segmentation has them.
        source: what each pixel's ray met first, ``clutter.OBJECT`` and so on.
        alone: depth of the object alone without noise, 0 around it.
        hidden: share of the object's pixels that are hidden or outside the picture.
    """

    mesh: SegmentedMesh
    whole: DepthImage
    mask: Bool[np.ndarray, "h w"]
    source: UInt8[np.ndarray, "h w"]
    alone: DepthImage
    hidden: float

    @property
    def depth(self) -> DepthImage:
        """Depth image cut out by the mask."""
        return DepthImage(np.where(self.mask, self.whole.depth, 0.0), self.whole.camera)

    def frame(self, unit_m: float | None = None) -> SensorFrame:
        """Frame as a sensor with a mask gives it, in scene units, of which one is ``unit_m`` metres."""
        depth = self.depth
        return SensorFrame(Path("simulated"), depth.to_points(), unit_m, "camera", depth, whole=self.whole)


def occlude(
    view: View,
    kind: Cut,
    share: float,
    rng: np.random.Generator,
    settings: GenerateConfig = GenerateConfig(),  # noqa: B008 (frozen)
    *,
    wall: bool = True,
) -> OccludedView:
    """View of the same state by the same camera, of which about a share of the object cannot be seen.

    Args:
        view: the object; its own depth image is not used.
        kind: what hides it. A screen and the picture's edge leave ``share`` exactly, up to one row of pixels.
        share: of the object's pixels, 0 to 1 (without 1).
        rng: decides where, and on the noise.
        settings: noise and sensor. What the sensor puts around the object at random is left out.
        wall: whether a wall is far behind the object; without it nothing is measured around object and occluder.

    Raises ``ValueError`` where no object pixel, or no share from 0 to 1, is there.
    """
    solids = Solids(view.mesh)
    camera = view.depth.camera
    if not 0 <= share < 1:
        raise ValueError(f"the hidden share is {share}; it must be at least 0 and less than 1: give for example 0.3")
    directions = camera.directions().reshape(-1, 3)
    hits = solids.first_hit(directions)
    visible = np.isfinite(hits.distance)
    if not visible.any():
        raise ValueError("the view shows 0 pixels of the object; at least one must be visible: take another view")
    rays = directions[visible]
    seen = Hits(hits.distance[visible], hits.normal[visible])
    placing, measuring = rng.spawn(2)
    occluders: Sequence[Occluding] = ()
    if kind == "screen":
        occluders = (screen_hiding(share, rays, seen, placing),)
    elif kind == "picture":
        camera = cropped(camera, visible.reshape(camera.height, camera.width), share, placing)
    elif kind != "none":
        reach = float(np.linalg.norm(directions[:, :2], axis=1).max())
        unit = 1 / settings.sensor.metres_per_unit
        occluders = occluder_hiding(kind, share, rays, seen, reach, unit, placing.spawn(PLACES))[0]
    backdrop = None
    if wall:
        away = np.array([0.0, 0.0, 1.0])
        backdrop = Backdrop(away, farthest(solids, away) + WALL_SIZES * float(np.ptp(view.mesh.bounds, axis=0).max()))
    around = surroundings(occluders, backdrop)
    measured = observe(solids, camera, settings.noise_std, settings.sensor, measuring, around=around)
    hidden = 1 - int((measured.source == OBJECT).sum()) / int(visible.sum())
    return OccludedView(
        view.mesh, measured.whole, measured.mask, measured.source, render_depth(solids, camera), max(hidden, 0.0)
    )


def surroundings(parts: Iterable[Occluding], backdrop: Backdrop | None) -> Surroundings:
    """Surroundings of anything that rays can hit; mereo's own have capsules alone."""
    return Surroundings(cast("tuple[Capsule, ...]", tuple(parts)), backdrop)


def screen_hiding(share: float, rays: Float[np.ndarray, "n 3"], seen: Hits, rng: np.random.Generator) -> Screen:
    """Screen nearer than all of an object that hides a share of the rays which meet it; its edge is turned at random.

    Args:
        share: of the rays, 0 to 1.
        rays: directions with z = 1 that meet the object.
        seen: where.
        rng: decides on the edge's direction.
    """
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle)])
    return Screen(NEARER * float(seen.distance.min()), axis, float(np.quantile(rays[:, :2] @ axis, share)))


def cropped(camera: Camera, visible: Bool[np.ndarray, "h w"], share: float, rng: np.random.Generator) -> Camera:
    """Camera whose picture leaves out the left, right, upper or lower columns or rows with a share of the pixels."""
    side = int(rng.integers(4))
    counts = np.cumsum(visible.sum(axis=side % 2))  # of columns, then of rows
    counts = counts if side < 2 else np.cumsum(visible.sum(axis=side % 2)[::-1])
    lost = int(np.searchsorted(counts, share * counts[-1]))
    width, height = camera.width - lost * (side % 2 == 0), camera.height - lost * (side % 2 == 1)
    shift = lost if side < 2 else 0
    return Camera(
        width,
        height,
        camera.focal_x_px,
        camera.focal_y_px,
        camera.center_x_px - shift * (side % 2 == 0),
        camera.center_y_px - shift * (side % 2 == 1),
    )


def occluder_hiding(
    kind: Occluder,
    share: float,
    rays: Float[np.ndarray, "n 3"],
    seen: Hits,
    reach: float,
    unit: float,
    streams: Sequence[np.random.Generator],
) -> tuple[tuple[Capsule, ...], float]:
    """Tool or hand that hides nearest to a share of the rays that meet an object, and the share that it hides.

    Args:
        kind: tool or hand.
        share: of the rays, 0 to 1.
        rays: directions with z = 1 that meet the object.
        seen: where.
        reach: slope x/z from the image's centre to its corners.
        unit: scene units in a metre.
        streams: one for each position that is tried. Those that leave fewer than ``MIN_POINTS`` rays are not taken.
    """
    points = rays * seen.distance[:, None]
    best: tuple[Capsule, ...] = ()
    hidden = 0.0
    for rng in streams:
        capsules = sample_occluder(kind, points, reach, unit, rng)
        left = int((Surroundings(capsules).join(seen, rays)[1] == OBJECT).sum())
        hides = 1 - left / len(rays)
        if left >= MIN_POINTS and (not best or abs(hides - share) < abs(hidden - share)):
            best, hidden = capsules, hides
    return best, hidden
