"""Depth images of real cameras: whatever they come as, the object is cut out of them, and a mask may be a little wrong.

None of the objects is one of ours and no truth is known, so this ends at what is left; scans with their truth are in
``test_isolation.py``.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from mereo.io.config import InputConfig
from mereo.io.intrinsics import read_camera
from mereo.io.readers import read_depth_image
from mereo.io.sensor_frame import read_frame
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import readings
from mereo.reconstruction.observation import Observation, find_object

FOLDER = Path(os.environ.get("MEREO_ASSETS", "")) / "depth"
pytestmark = pytest.mark.skipif(
    not (FOLDER / "tum_depth_5000.png").exists(), reason="MEREO_ASSETS holds no real depth frames"
)
PERSON, TABLE = FOLDER / "pcl_person_depth_mm.png", FOLDER / "pcl_milk_depth_mm.png"
SITTING, DESK = FOLDER / "open3d_person_depth_mm.png", FOLDER / "tum_depth_5000.png"
KINECT, PRIMESENSE = FOLDER / "intrinsics.json", FOLDER / "open3d_camera_primesense.json"
BOTTLE = IsolationConfig(box=(-0.35, -0.3, 0.4, -0.07, 0.3, 1.0), remove_plane=True, largest_cluster=True)


CARTON = IsolationConfig((0.4, 1.0), remove_plane=True, largest_cluster=True)
SITS = IsolationConfig((0.4, 1.3), largest_cluster=True, cluster_gap=0.05)
CHAIR = IsolationConfig((1.4, 1.95), largest_cluster=True)
CUT_OUT = {
    "person": (PERSON, KINECT, None, IsolationConfig((0.4, 1.5), largest_cluster=True), (0.33, 0.48, 0.38), 0.77),
    "bottle": (TABLE, KINECT, None, BOTTLE, (0.11, 0.20, 0.13), 0.65),
    "carton": (TABLE, KINECT, None, CARTON, (0.15, 0.25, 0.17), 0.77),
    "sitting person": (SITTING, PRIMESENSE, None, SITS, (0.42, 0.65, 0.22), 0.76),
    "chair": (DESK, KINECT, 5000.0, CHAIR, (0.63, 0.57, 0.48), 1.72),
}


@pytest.mark.parametrize("name", CUT_OUT)
def test_the_object_is_cut_out_of_every_real_image(name: str) -> None:
    path, camera, depth_scale, isolation, size_m, middle_m = CUT_OUT[name]
    found = find_object(read_frame(path, InputConfig(camera, depth_scale=depth_scale)), isolation)
    assert found.size_m == pytest.approx(size_m, abs=0.01)
    assert found.depth_m[1] == pytest.approx(middle_m, abs=0.01)
    (only,) = readings(found.cloud)
    assert only.dropped == 0, "no strays are seen in what was cut out well"


@cache
def millimetres() -> np.ndarray:
    return np.array(Image.open(TABLE)).astype(np.uint16)


def organized() -> np.ndarray:
    """The table as an organized cloud in metres [h, w, 3], zero where nothing was measured."""
    image = read_depth_image(TABLE, read_camera(KINECT))
    points = np.zeros((*image.depth.shape, 3))
    points[image.valid] = image.to_points().points
    return points


def save_picture(values: np.ndarray) -> Callable[[Path], None]:
    return lambda path: Image.fromarray(values).save(path)


INVALID = InputConfig(drop_invalid=True)
FORMATS: dict[str, tuple[Callable[[Path], None], InputConfig]] = {
    "millimetres.tif": (lambda path: save_picture(millimetres())(path), InputConfig(KINECT)),
    "metres.tiff": (lambda path: save_picture(millimetres() / np.float32(1000))(path), InputConfig(KINECT)),
    "tenths.png": (lambda path: save_picture(10 * millimetres())(path), InputConfig(KINECT, depth_scale=10_000.0)),
    "image.npy": (lambda path: np.save(path, millimetres()), InputConfig(KINECT)),
    "organized.npy": (lambda path: np.save(path, organized()), INVALID),
    "integers.npy": (  # as the Azure Kinect's kit gives them
        lambda path: np.save(path, np.rint(1000 * organized()).astype(np.int16)),
        replace(INVALID, unit_m=0.001),
    ),
    "cloud.npz": (
        lambda path: np.savez(path, points=1000 * organized().reshape(-1, 3)),
        replace(INVALID, unit_m=0.001),
    ),
}


@pytest.mark.parametrize("name", FORMATS)
def test_the_bottle_is_the_same_from_images_and_arrays(tmp_path: Path, name: str) -> None:
    """Formats with a writer of their own are in `tests/io`."""
    save, reading = FORMATS[name]
    save(tmp_path / name)
    found = find_object(read_frame(tmp_path / name, reading), BOTTLE)
    known = find_object(read_frame(TABLE, InputConfig(KINECT)), BOTTLE)
    assert len(found.cloud) == pytest.approx(len(known.cloud), rel=0.01)
    assert found.size_m == pytest.approx(known.size_m, abs=0.002)
    assert found.depth_m == pytest.approx(known.depth_m, abs=0.002)


def masked(folder: Path, pixels: int) -> Observation:
    """The person by a mask that is this many pixels too large on every side, or too small."""
    depth = np.array(Image.open(PERSON))
    near, _ = ndimage.label((depth > 0) & (depth < 1100))
    person = near == np.bincount(near.ravel())[1:].argmax() + 1
    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    mask = change(person, np.ones((3, 3)), iterations=abs(pixels)) if pixels else person
    Image.fromarray(mask).save(folder / "mask.png")
    return find_object(read_frame(PERSON, InputConfig(KINECT, mask=folder / "mask.png")))


@pytest.mark.parametrize("pixels", [-4, 0, 1, 2])
def test_a_mask_that_is_two_pixels_off_leaves_the_person_alone(tmp_path: Path, pixels: int) -> None:
    """What is behind the person stretches the box to eight times its length, and is told as strays."""
    found = masked(tmp_path, pixels)
    first = readings(found.cloud)[0]
    assert (found.cloud.points[:, 2] > 1.1).any() == (pixels > 0)
    assert first.cloud.points[:, 2].max() < 1.1
    assert np.ptp(first.cloud.points, axis=0) == pytest.approx((0.33, 0.484, 0.376), abs=0.03)
    assert (first.whole.points[~first.keep, 2] < 1.1).sum() <= 10, "and hardly any of the person goes with it"
