"""Picture of a model placed on a scan."""

import numpy as np

from mereo.evaluation.placement import Placement
from mereo.evaluation.scans import ScanFile
from mereo.geometry.camera import PointCloud, camera_axes
from mereo.geometry.conventions import UNITS_M
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.visualization.contact_sheets import Picture, contact_sheet, legend
from mereo.visualization.previews import CAMERA_VIEWS
from mereo.visualization.renderer import Canvas, Triangles, Viewpoint
from mereo.visualization.viridis import viridis

SHOWN_POINTS = 40_000
"""Most points of the scan that a picture shows."""

SIZE = 420
"""Width and height of a picture in pixels."""

TOO_FAR = (0.85, 0.1, 0.1)
"""Colour of scan points that do not lie on the placed object."""


def overlay(placement: Placement, cloud: PointCloud, scan: ScanFile) -> Picture:
    """Picture of a scan on the placed segments (top) and of its distance from them (bottom), from several sides."""
    to_camera = camera_axes(scan.frame)
    mesh = placement.mesh.transformed(to_camera)
    chosen = np.random.default_rng(0).permutation(len(cloud))[:SHOWN_POINTS]
    points = transform_points(to_camera, cloud.points[chosen])
    distance = Solids(mesh).nearest(points).distance
    views = {name: Viewpoint.along(mesh.bounds, *pair) for name, pair in CAMERA_VIEWS.items()}
    mm = 1000 * UNITS_M[scan.unit] * placement.limit
    near = viridis(distance / placement.limit) / 255
    colors = np.where((distance > placement.limit)[:, None], TOO_FAR, near)
    ink = np.zeros_like(points)
    top = [_drawn(view, mesh, points, ink) for view in views.values()]
    bottom = [_drawn(view, None, points, colors) for view in views.values()]
    captions = [f"scan on segments, {name}" for name in views]
    captions += [f"distance 0 (dark) to {mm:.2g} mm (bright), red: more"] * len(views)
    sheet = contact_sheet(top + bottom, captions, len(views), f"{scan.path.name} on {len(mesh.segments)} segments")
    return np.concatenate([sheet, legend(mesh.names, mesh.colors, sheet.shape[1])])


def _drawn(view: Viewpoint, mesh: SegmentedMesh | None, points: np.ndarray, colors: np.ndarray) -> Picture:
    canvas = Canvas.empty(view, (SIZE, SIZE))
    if mesh is not None:
        canvas.draw_triangles(Triangles.of(mesh))
    canvas.draw_points(points, colors, 0.5 if mesh is not None else 1.2)
    return canvas.picture()
