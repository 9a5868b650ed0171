"""Parts of a panel that pages of results share: observed points, the depth image, views from three sides."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import DepthImage, PointCloud
from mereo.visualization.contact_sheets import Picture, enlarge
from mereo.visualization.depth_picture import depth_data, depth_picture
from mereo.visualization.units import Unit
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import CLOUD_COLOR, Display, point_size

PICTURE_PX = 320
"""Width of a picture in the panel, to which small ones are enlarged: a browser would blur their pixels."""


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """Depth image as a page shows it.

    Attributes:
        picture: the image, near is bright.
        ends: the nearest and farthest depth in words; none of an image without measurements.
    """

    picture: Picture
    ends: Sequence[str]

    @classmethod
    def of(cls, depth: DepthImage | None, unit: Unit) -> "DepthPicture | None":
        """Picture of an image whose depths are in this unit; None without one."""
        return None if depth is None else cls(depth_picture(depth), depth_data(depth, unit)["ends"])


def add_cloud(gui: Any, stage: Display, seen: PointCloud, coloring: Any | None = None) -> None:
    """Show observed points, with a check box and a slider of their size.

    They are hidden while ``coloring``, a choice of colours, is another one than that of the segments.
    """
    points = stage.place(seen.points)
    with gui.add_folder("Observed points"):
        cloud_on = gui.add_checkbox("show", True)
        size = gui.add_slider("size (%)", 0.05, 4.0, 0.05, round(100 * point_size(points), 2))
    cloud = stage.server.scene.add_point_cloud(
        "/cloud", points, CLOUD_COLOR, point_size=size.value / 100, point_shape="circle", precision="float32"
    )
    cloud_on.on_update(lambda _: setattr(cloud, "visible", cloud_on.value))
    size.on_update(lambda _: setattr(cloud, "point_size", size.value / 100))
    if coloring is not None:
        # white points would hide the colours that are looked at
        coloring.on_update(lambda _: setattr(cloud_on, "value", coloring.value == "segment"))


def add_depth(gui: Any, depth: DepthPicture | None) -> None:
    """Show a depth image in the panel, where there is one."""
    if depth is None:
        return
    with gui.add_folder("Depth image"):
        shown = depth.picture if depth.picture.shape[1] >= PICTURE_PX else enlarge(depth.picture, PICTURE_PX)
        gui.add_image(shown, format="png")
        if len(depth.ends) == 2:
            gui.add_html(html.message(f"bright: {depth.ends[0]}; dark: {depth.ends[1]}"))


def add_views(
    gui: Any,
    stage: Display,
    toward: Float[np.ndarray, "3"],
    bounds: Callable[[], Float[np.ndarray, "2 3"]],
    first: str = "camera",
) -> None:
    """Add buttons that turn the page to ``bounds`` as seen from ``toward`` (``first``), its side and its back."""
    directions = {first: toward, "side": np.cross(stage.up, toward), "behind": -toward}
    view = gui.add_button_group("View", tuple(directions))
    view.on_click(lambda _: stage.look_from(directions[view.value], bounds()))
