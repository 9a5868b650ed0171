"""Real scans lie on their truth, in a camera frame."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mereo.geometry.camera import VIEW_DISTANCE, into_camera
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Normalizer, inverse_rigid, transform_points
from mereo_learning.scans import SCANS, bunny_scan, bunny_truth, scan_in_camera

Require = Callable[[str], Path]


def test_a_scan_is_put_before_the_camera() -> None:
    """Nearer to the scanner (larger z) becomes nearer to the camera (smaller z); up becomes minus y."""
    scan = np.random.default_rng(0).uniform(-1, 1, size=(200, 3)) * [0.3, 0.5, 0.1] + [4.0, 5.0, 6.0]
    T_camera_scanner = into_camera(scan, "scanner")
    seen = transform_points(T_camera_scanner, scan)
    np.testing.assert_allclose(T_camera_scanner[:3, :3] @ T_camera_scanner[:3, :3].T, np.eye(3))
    assert np.linalg.det(T_camera_scanner[:3, :3]) == pytest.approx(1.0)
    for axis, sign in ((0, 1), (1, -1), (2, -1)):
        np.testing.assert_array_equal(np.argsort(seen[:, axis]), np.argsort(sign * scan[:, axis]))
    np.testing.assert_allclose(Normalizer.fit(seen).viewpoint, [0.0, 0.0, -VIEW_DISTANCE], atol=1e-12)
    np.testing.assert_allclose(transform_points(inverse_rigid(T_camera_scanner), seen), scan)
    with pytest.raises(ValueError, match="there is no scan 'bun045'; it must be one of bun000, bun090, bun270, chin"):
        bunny_scan("bun045")


@pytest.mark.parametrize("name", SCANS)
def test_the_truth_lies_where_the_scan_is(name: str, require_asset: Require) -> None:
    """The pose is right: half of the scan lies within 0.15 mm of the surface, and outside as much as inside."""
    require_asset("bunny/bunny.off"), require_asset(f"bunny/{name}.ply")
    cloud, truth, T_camera_scan = scan_in_camera(name)
    points = cloud.points[::20]
    solids = Solids(truth)
    # cut faces lie inside, so the nearest surface of a scanned point is the bunny's skin
    distance = np.abs(solids.nearest(points).distance)
    assert np.median(distance) < 1.5e-4 and np.quantile(distance, 0.95) < 6e-4
    assert 0.2 < (solids.label(points) > 0).mean() < 0.8
    np.testing.assert_allclose(
        truth.bounds, bunny_truth(name).transformed(T_camera_scan).bounds, err_msg="scan frame and camera frame agree"
    )
    # the side that the camera sees: scanned points lie nearer than the middle of the object
    assert points[:, 2].min() > 0 and points[:, 2].mean() < truth.bounds.mean(axis=0)[2]
