"""Ball query and nearest neighbours against slow references."""

import subprocess
import sys

import pytest
import torch

from mereo.models.neighbors import _by_rank, ball_query, gather, nearest, squared_distances


def random_points(batch: int, count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(batch, count, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def slow_ball_query(centers: torch.Tensor, points: torch.Tensor, radius: float, limit: int) -> torch.Tensor:
    result = torch.empty(*centers.shape[:2], limit, dtype=torch.long)
    for b in range(len(centers)):
        for m, center in enumerate(centers[b]):
            inside = [n for n, p in enumerate(points[b]) if float(((p - center) ** 2).sum()) <= radius**2][:limit]
            result[b, m] = torch.tensor(inside + [inside[0]] * (limit - len(inside)))
    return result


def test_ball_query_equals_slow_reference() -> None:
    points = random_points(2, 90)
    for radius, limit in ((0.3, 8), (0.9, 16), (0.01, 4), (3.0, 90)):
        fast = ball_query(points[:, :30], points, radius, limit)
        assert torch.equal(fast, slow_ball_query(points[:, :30], points, radius, limit))


def test_ball_query_prefers_the_front_of_the_order() -> None:
    points = random_points(1, 200)
    index = ball_query(points[:, :10], points, 10.0, 12)
    assert torch.equal(index, torch.arange(12).expand(1, 10, 12))


def test_nearest_equals_sorting() -> None:
    queries, points = random_points(2, 17, 1), random_points(2, 50, 2)
    order = torch.cdist(queries, points).argsort(dim=-1)[..., :5]
    assert torch.equal(nearest(queries, points, 5), order)


def test_squared_distances_keep_digits_far_from_the_origin() -> None:
    a = torch.tensor([[[1000.0, 0.0, 0.0]]])
    b = torch.tensor([[[1000.0, 0.01, 0.0]]])
    assert torch.allclose(squared_distances(a, b), torch.tensor([[[1e-4]]]), rtol=1e-3)


def test_gather_equals_indexing() -> None:
    values, index = random_points(3, 20), torch.randint(0, 20, (3, 5, 4), generator=torch.Generator().manual_seed(1))
    expected = torch.stack([values[b][index[b]] for b in range(3)])
    assert torch.equal(gather(values, index), expected)


def test_ball_query_finds_the_same_on_every_device() -> None:
    points = random_points(3, 400, 5)
    for radius, limit in ((0.2, 8), (0.5, 24), (0.01, 4)):
        assert torch.equal(
            ball_query(points[:, :90], points, radius, limit), _by_rank(points[:, :90], points, radius, limit)
        )


COMPILED = """
import torch
from mereo.models.neighbors import ball_query, nearest

points, queries = torch.rand(2, 60, 3), torch.rand(2, 40, 3)
def both(points, queries):
    return ball_query(points[:, :20], points, 0.4, 8), nearest(queries, points, 3)
found, expected = torch.compile(both, fullgraph=True)(points, queries), both(points, queries)
assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
"""


@pytest.mark.slow
def test_compiled_networks_call_the_same_searches() -> None:
    """In a process of its own: the shape checks of these tests cannot be compiled."""
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_nearest_finds_the_same_in_exported_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points = random_points(2, 40, 3), random_points(2, 30, 4)
    by_tree = nearest(queries, points, 40)
    monkeypatch.setattr("mereo.models.neighbors.is_exporting", lambda: True)
    assert by_tree.shape == (2, 40, 30)
    assert torch.equal(nearest(queries, points, 40), by_tree)
    assert nearest(queries[..., :2], points[..., :2], 1).shape == (2, 40, 1)
