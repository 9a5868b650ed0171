"""Answers of known shapes, and what a report's page holds of them."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import shapes

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.mesh import Segment, SegmentedMesh


def ball(name: str, shift: float, color: int, level: int = 3) -> Segment:
    return shapes.ball((shift, 0.0, 0.5), 0.1, name, color, level)


def example() -> tuple[PointCloud, SegmentedMesh, dict[str, object]]:
    lost = Segment("lost", (0, 158, 115), np.empty((0, 3)), np.empty((0, 3), np.int64))
    mesh = SegmentedMesh((ball("head", -0.1, 0), ball("tail </script><b>", 0.1, 1), lost))
    summary = {
        "title": "A <b>bold</b> </script> title",
        "points": 104,
        "frame": "camera",
        "precision": "float32",
        "clipped": True,
        "spacing": 0.00201,
        "input": Path("scan.ply"),
        "segments": [
            {"name": s.name, "centroid": np.array([0.1, 0.2, 0.3]), "volume": np.float64(s.volume), "confidence": 0.5}
            for s in mesh.segments[:2]
        ]
        + [{"name": "lost", "centroid": None, "volume": 0.0, "confidence": float("nan")}],
        "timings_s": {"encode": 0.1, "field": np.float32(1.5)},
    }
    return PointCloud(mesh.segments[0].vertices[::3]), mesh, summary


def page_data(path: Path) -> dict:
    found = re.search(r"const DATA = (.*);\n", path.read_text(encoding="utf-8"))
    assert found
    return json.loads(found[1])


def positions(data: dict, text: str) -> np.ndarray:
    low, high = np.asarray(data["low"]), np.asarray(data["high"])
    steps = np.frombuffer(base64.b64decode(text), "<u2").reshape(-1, 3)
    return low + steps / 65535 * (high - low)


def wall(width: int, height: int, unit: float = 1.0) -> DepthImage:
    """Image of a slanted wall in the middle of an empty frame, 0.5 m to 0.7 m away."""
    depth = np.zeros((height, width))
    depth[height // 4 : height // 2, width // 4 : width // 2] = np.linspace(0.5, 0.7, width // 2 - width // 4) * unit
    return DepthImage(depth, Camera.from_fov(width, height, 0.7))
