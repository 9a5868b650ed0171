"""Files of cameras as tests write them."""

import json
from pathlib import Path

from mereo.geometry.camera import Camera


def write_camera(path: Path, camera: Camera) -> None:
    """Intrinsics that ``read_camera`` reads back exactly; pixel centres are stated to be at 0.5."""
    focal = {"fx": camera.focal_x_px, "fy": camera.focal_y_px}
    center = {"cx": camera.center_x_px, "cy": camera.center_y_px, "pixel_center": 0.5}
    path.write_text(json.dumps({"width": camera.width, "height": camera.height, **focal, **center}))
