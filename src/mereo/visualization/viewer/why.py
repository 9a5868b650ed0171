"""Why the model is where it is: the observed points of a page, coloured by how much they decide a probed place."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.visualization.sure_colors import mark_colors, point_marks, shares_told
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import Display, point_size
from mereo.visualization.viewer.probe import Inspection

POINTS = "/why"
LARGER = 1.6
"""Size of the points, in sizes of the cloud's own, which they cover."""


class WhyLayer:
    """Check box of the probe, and the coloured points that it shows."""

    def __init__(self, gui: Any, stage: Display, inspection: Inspection) -> None:
        self.stage, self.inspection = stage, inspection
        self.box = gui.add_checkbox("show what decides it", False)
        self.told = gui.add_html("", visible=False)
        self.box.on_update(lambda _: self._draw())
        self._place: Float[np.ndarray, "3"] | None = None
        self._points: Any = None

    @classmethod
    def of(cls, gui: Any, stage: Display, inspection: Inspection) -> "WhyLayer | None":
        """Layer of a page whose answer is a registered model with the points that it was fitted to, else None."""
        return None if inspection.here is None or inspection.cloud is None else cls(gui, stage, inspection)

    def show(self, place: Float[np.ndarray, "3"]) -> None:
        """Explain a place of the input's frame, where the box is checked."""
        self._place = place
        self._draw()

    def _draw(self) -> None:
        if self._points is not None:
            self._points.remove()
            self._points = None
        self.told.visible = bool(self.box.value)
        here, cloud = self.inspection.here, self.inspection.cloud
        if not self.box.value or self._place is None or here is None or cloud is None:
            return
        found = here.explain(self._place)
        assert found is not None
        lost = f"; {len(found.unexplained)} points in red are not the model's" if len(found.unexplained) else ""
        said = f"yellow points decide its place most, grey ones not at all{lost}"
        self.told.content = html.message(f"{said}; what leaves it unsure: {shares_told(found)}")
        points = self.stage.place(cloud.points)
        self._points = self.stage.server.scene.add_point_cloud(
            POINTS,
            points,
            mark_colors(point_marks(found, cloud.points)),
            point_size=LARGER * point_size(points),
            point_shape="circle",
            precision="float32",
        )
