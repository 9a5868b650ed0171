"""Depth images of real cameras: whatever they come as, the object is cut out of them, and a mask may be a little wrong.

None of the objects is one of ours and no truth is known, so this ends at what is left; scans with their truth are in
``test_isolation.py``.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from mereo.io.config import InputConfig
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
