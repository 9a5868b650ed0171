"""Get an object out of a crowded frame, and look at what is kept.

    python examples/isolate_object.py
    python examples/isolate_object.py --input depth.png --intrinsics camera.json --depth-range 0.4 1.0 --remove-plane

Without an input it takes a real scan of the Stanford bunny, puts it on a table before a wall with points floating
about, and scores the reconstruction against the truth: the scan alone, crowded, and isolated again. With one it reads
your file with the options of `mereo reconstruct` and writes pictures of what was there and of what is kept, without the
strays that would be dropped there where no registration decides.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import readings
from mereo.reconstruction.observation import find_object, observe
from mereo.visualization.contact_sheets import cloud_picture, contact_sheet, save_png
from mereo.visualization.renderer import Viewpoint
from mereo_learning.scans import scan_in_camera
from mereo_learning.scoring import grid_scores

SCAN = "bun000"


def crowd(scan: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    """A scan in a camera frame, metres, on a table of 30 x 30 cm, 15 cm before a wall, with 150 floating points.

    What the object hides from the camera is left out.
    """
    low, high = scan.min(axis=0), scan.max(axis=0)
    x, y, z = (low + high) / 2
    table = rng.uniform((x - 0.15, high[1], z - 0.15), (x + 0.15, high[1], z + 0.15), (60_000, 3))
    wall = rng.uniform((x - 0.2, y - 0.2, z + 0.15), (x + 0.2, high[1], z + 0.15), (60_000, 3))
    floating = rng.uniform((x - 0.2, y - 0.2, z - 0.3), (x + 0.2, y + 0.1, z + 0.15), (150, 3))
    around = np.concatenate([table, wall, floating]) + rng.normal(0, 2e-4, (120_150, 3))
    seen = set(map(tuple, _pixels(scan)))
    hidden = np.array([pixel in seen for pixel in map(tuple, _pixels(around))]) & (around[:, 2] > z)
    return np.concatenate([scan, around[~hidden]])


def _pixels(points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Columns and rows in an image of 500 pixels focal length."""
    return np.floor(500 * points[:, :2] / points[:, 2:]).astype(int)


def crowded_bunny(output: Path, force: bool) -> None:
    """Print and draw the scan alone, crowded and isolated."""
    scan, truth, _ = scan_in_camera(SCAN)
    crowded = PointCloud(crowd(scan.points, np.random.default_rng(0)))
    near, far = scan.points[:, 2].min() - 0.05, scan.points[:, 2].max() + 0.05
    config = IsolationConfig(depth_range=(near, far), remove_plane=True, largest_cluster=True, cluster_gap=0.05)
    isolated = find_object(observe(crowded, unit_m=1.0).frame, config)
    print(isolated)
    model = load_model("bunny")
    for name, cloud in (("alone", scan), ("crowded", crowded), ("isolated", isolated.cloud)):
        scores = grid_scores(model, cloud, truth, cells=64)
        print(f"{name:<9} {len(cloud):>7} points  IoU {scores.iou:.3f}  mIoU {scores.miou:.3f}")
    draw(output, {"crowded": crowded, "isolated": isolated.cloud}, force)


def draw(path: Path, clouds: dict[str, PointCloud], force: bool) -> None:
    """Each cloud as the camera sees it and from its right."""
    pictures, captions = [], []
    for name, cloud in clouds.items():
        bounds = np.quantile(cloud.points, [0.001, 0.999], axis=0)
        for direction, side in (((0.0, 0.0, 1.0), "as the camera sees it"), ((-1.0, 0.0, 0.0), "from its right")):
            view = Viewpoint.along(bounds, direction, (0.0, -1.0, 0.0))
            pictures.append(cloud_picture(cloud.points, view, (420, 420)))
            captions.append(f"{name}, {side}")
    with atomic_file(path, force=force) as partial:
        save_png(partial, contact_sheet(pictures, captions, 4))
    print(f"wrote {path}")


def main(
    input: Path | None = None,
    reading: Annotated[InputConfig, tyro.conf.arg(name="")] = InputConfig(),  # noqa: B008 (frozen)
    isolation: Annotated[IsolationConfig, tyro.conf.arg(name="")] = IsolationConfig(),  # noqa: B008
    output: Path = Path("out/isolated.png"),
    force: bool = False,
) -> None:
    try:
        check_file_place(output, force=force, inputs=[] if input is None else [input])
        if input is None:
            crowded_bunny(output, force)
            return
        found = find_object(read_frame(input, reading), isolation)
        whole = read_frame(input, replace(reading, mask=None))
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {error}") from None
    likely = readings(found.cloud, found.frame.axes, isolation.keep_all)[0]
    print(found.read_as(likely))
    draw(output, {"everything": whole.cloud, "the object": likely.cloud}, force)


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,))
