"""Previews: a reconstruction or a placed scan from several sides, states of scenes, and an object's modes.

Everything is drawn by ``mereo.visualization.renderer``, without a display.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import trimesh
from numpy.linalg import norm

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Triple
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.transforms import Corners, Points, Vector, box_of
from mereo.io.errors import AnyPath
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view
from mereo.visualization.contact_sheets import (
    Picture,
    cloud_picture,
    contact_sheet,
    depth_to_rgb,
    enlarge,
    legend,
    save_png,
)
from mereo.visualization.renderer import Viewpoint, shade, shaded_canvas

CAMERA_VIEWS = {
    "as the camera sees it": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "from its right": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "from behind": ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
}
"""Viewing direction and up of the pictures of a reconstruction, in the camera frame."""


def render_cloud_and_segments(
    path: AnyPath,
    cloud: PointCloud,
    surfaces: SegmentedMesh,
    title: str = "",
    size: int = 420,
) -> None:
    """Write a preview of a reconstruction: input cloud (top), segments (bottom); from the camera, its right and behind.

    Args:
        path: the .png file.
        cloud: what was observed, camera frame.
        surfaces: what was reconstructed, in the same frame; segments without faces are left out.
        title: one line above.
        size: width and height of each of the six pictures in pixels.
    """
    bounds = _joint_bounds(cloud.points, surfaces)
    views = {name: Viewpoint.along(bounds, *pair) for name, pair in CAMERA_VIEWS.items()}
    clouds = [cloud_picture(cloud.points, view, (size, size)) for view in views.values()]
    shaded = [shade(surfaces, view, (size, size)) for view in views.values()]
    captions = [f"input, {name}" for name in views] + [f"segments, {name}" for name in views]
    sheet = contact_sheet(clouds + shaded, captions, 3, title)
    save_png(path, np.concatenate([sheet, legend(surfaces.names, surfaces.colors, sheet.shape[1])]))


def points_on_segments(
    points: Points, surfaces: SegmentedMesh, sides: Sequence[tuple[Triple, Triple]], size: int
) -> list[Picture]:
    """Pictures of the segments with the observed points on them as dark dots, one from each side.

    Args:
        points: observed, camera frame.
        surfaces: reconstructed, in the same frame; segments without faces are left out.
        sides: viewing direction and up of each, as in ``CAMERA_VIEWS``.
        size: width and height in pixels; what is shown fills it.
    """
    pictures = list[Picture]()
    bounds = _joint_bounds(points, surfaces)
    for direction, up in sides:
        view = Viewpoint.along(bounds, direction, up)
        canvas = shaded_canvas(surfaces, view, (size, size))
        # nearer by a share of the picture's height, or noise would hide half of them
        lifted = points - 0.012 * 2 * view.half_size * np.asarray(direction)
        canvas.draw_points(lifted, np.tile((0.09, 0.1, 0.13), (len(points), 1)), 0.75)
        pictures.append(canvas.picture())
    return pictures


def _joint_bounds(points: Points, solid: SegmentedMesh) -> Corners:
    joint = np.concatenate([points, *(segment.vertices for segment in solid.segments if len(segment.faces))])
    return box_of(joint)


# --- states of one scene ---------------------------------------------------------------------------------------------


def preview_scene(scene: Scene, path: AnyPath, seed: int) -> None:
    """Write ``preview_states`` of nine random states of a scene; state i comes from (seed, i) alone."""
    settings = GenerateConfig()
    views = [sample_view(scene, settings, example_rng(seed, index)) for index in range(9)]
    # scenes in code that are seen from all around state no axis; their meshes are mostly y up
    up = (0.0, 1.0, 0.0) if scene.workspace.all_around and scene.file is None else scene.workspace.axis
    preview_states(path, views, f"{scene.name}: 9 random states", up=up)


def preview_states(
    path: AnyPath,
    views: Sequence[View],
    title: str = "",
    size: int = 220,
    up: Triple = (0.0, 0.0, 1.0),
) -> None:
    """Write a sheet of states, three in a row: what the camera sees, the state from a fixed side, the depth image.

    The fixed side is the same world direction for all states; an arrow shows where the camera looks from.

    Args:
        path: the .png file.
        views: the states, see ``mereo.synthesis.examples.sample_view``.
        title: one line above.
        size: width of each picture in pixels.
        up: the world direction that is upwards in the fixed side's pictures.
    """
    images = list[Picture]()
    captions = list[str]()
    for number, view in enumerate(views, start=1):
        camera = view.depth.camera
        height = size * camera.height // camera.width
        images += [shade(view.mesh, Viewpoint.through(camera), (size, height)), _from_side(view, size, up)]
        images.append(enlarge(depth_to_rgb(view.depth), size))
        captions += [f"{number}: camera", "fixed side, arrow = camera", f"depth, {int(view.depth.valid.sum())} pixels"]
    save_png(path, contact_sheet(images, captions, 9, title))


def _from_side(view: View, size: int, up: Triple) -> Picture:
    world = view.mesh.transformed(view.T_world_camera)
    center = world.bounds.mean(axis=0)
    radius = float(norm(world.bounds[1] - world.bounds[0])) / 2
    toward = view.T_world_camera[:3, 3] - center
    arrow = _arrow(center, toward / norm(toward), radius)
    # an arrow that points away from the viewer is hidden by the object, as it should be
    shown = replace(world, segments=(*world.segments, arrow))
    z = np.asarray(up) / norm(up)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    direction = -(x / norm(x) + 0.35 * np.cross(z, x) + 0.4 * z)
    side = Viewpoint.along(world.bounds, (direction[0], direction[1], direction[2]), up)
    return shade(shown, replace(side, half_size=1.4 * radius), (size, size))


def _arrow(center: Vector, toward: Vector, radius: float) -> Segment:
    """A cone on a thin shaft outside the object, pointing at it along the camera's line of sight."""
    # (thickness, distance from the centre), both in radii, from the tip to the end of the shaft
    profile = ((0.0, 0.85), (0.08, 1.03), (0.03, 1.03), (0.03, 1.35), (0.0, 1.35))
    cone = trimesh.creation.revolve(profile, sections=16)
    cone.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], toward))
    return Segment("camera direction", (40, 44, 52), center + radius * cone.vertices, np.array(cone.faces))
