"""Random subsets of clouds; grids are in test_isolation."""

import numpy as np
import pytest

from mereo.geometry.downsampling import random_subset


@pytest.mark.parametrize("limit", [1, 7, 49, 50, 51])
def test_a_random_subset_is_the_same_every_time(limit: int) -> None:
    """Rows of the cloud, each at most once; all of them, in their order, where they are few enough."""
    points = np.random.default_rng(3).normal(size=(50, 3))
    chosen = random_subset(points, limit)
    assert len(chosen) == min(limit, 50) == len(np.unique(chosen, axis=0))
    assert set(map(tuple, chosen)) <= set(map(tuple, points))
    assert np.array_equal(chosen, random_subset(points.copy(), limit))
    assert np.array_equal(chosen, points[random_subset(np.arange(50), limit)])
    assert limit < 50 or chosen is points


def test_every_row_is_as_likely() -> None:
    """A tenth of a line's points lie as its points do: no corner of the cloud is preferred."""
    line = np.linspace(0, 1, 100_000)
    kept = np.sort(random_subset(line, 10_000))
    assert np.abs(kept - np.linspace(0, 1, 10_000)).max() < 0.02
