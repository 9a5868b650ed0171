"""Ball query and nearest neighbours against slow references."""

import pytest
import torch

from mereo.neighbors import ball_query, gather, nearest, squared_distances


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


def test_nearest_finds_the_same_where_the_graph_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points = random_points(2, 40, 3), random_points(2, 30, 4)
    by_tree = nearest(queries, points, 40)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert by_tree.shape == (2, 40, 30)
    assert torch.equal(nearest(queries, points, 40), by_tree)
    assert nearest(queries[..., :2], points[..., :2], 1).shape == (2, 40, 1)
