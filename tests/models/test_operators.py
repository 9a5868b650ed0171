"""Operators of the networks: neighbours, rigid fits and stand-ins for what ONNX lacks, against slow references."""

import subprocess
import sys

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from mereo.models.export.onnx_export import trilinear
from mereo.models.neighbors import _by_rank, ball_query, gather, nearest, squared_distances
from mereo.models.network import Network
from mereo.models.rigid_alignment import Alignment, fit_rigid, svd3
from mereo_learning.config import PRESETS
from mereo_learning.losses import rest_loss

TINY = PRESETS["tiny"].network


def random_points(batch: int, count: int, seed: int = 0) -> Tensor:
    return torch.rand(batch, count, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def slow_ball_query(centers: Tensor, points: Tensor, radius: float, limit: int) -> Tensor:
    result = torch.empty(*centers.shape[:2], limit, dtype=torch.long)
    for b in range(len(centers)):
        for m, center in enumerate(centers[b]):
            inside = [n for n, p in enumerate(points[b]) if float(((p - center) ** 2).sum()) <= radius**2][:limit]
            result[b, m] = torch.tensor(inside + [inside[0]] * (limit - len(inside)))
    return result


def test_ball_query_equals_slow_reference_on_every_device() -> None:
    points = random_points(2, 90)
    for radius, limit in ((0.3, 8), (0.9, 16), (0.01, 4), (3.0, 90), (10.0, 12)):
        expected = slow_ball_query(points[:, :30], points, radius, limit)
        for query in (ball_query, _by_rank):  # on the CPU, and on other devices
            assert torch.equal(query(points[:, :30], points, radius, limit), expected)


def test_nearest_equals_sorting_also_in_exported_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points = random_points(2, 17, 1), random_points(2, 50, 2)
    order = torch.cdist(queries, points).argsort(dim=-1)[..., :5]
    assert torch.equal(nearest(queries, points, 5), order)
    queries, points = random_points(2, 40, 3), random_points(2, 30, 4)
    by_tree = nearest(queries, points, 40)
    monkeypatch.setattr("mereo.models.neighbors.is_exporting", lambda: True)
    assert by_tree.shape == (2, 40, 30)
    assert torch.equal(nearest(queries, points, 40), by_tree)
    assert nearest(queries[..., :2], points[..., :2], 1).shape == (2, 40, 1)


def test_squared_distances_keep_digits_far_from_the_origin_and_gather_equals_indexing() -> None:
    a = torch.tensor([[[1000.0, 0.0, 0.0]]])
    b = torch.tensor([[[1000.0, 0.01, 0.0]]])
    assert torch.allclose(squared_distances(a, b), torch.tensor([[[1e-4]]]), rtol=1e-3)
    values = random_points(3, 20)
    index = torch.randint(0, 20, (3, 5, 4), generator=torch.Generator().manual_seed(1))
    expected = torch.stack([values[b][index[b]] for b in range(3)])
    assert torch.equal(gather(values, index), expected)


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


def matrices(count: int) -> Tensor:
    return torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))


def special() -> Tensor:
    """Equal singular values, rank two, a reflection, columns in no order of length, and values far apart."""
    flat = matrices(1)[0].clone()
    flat[:, 2] = flat[:, 0] + flat[:, 1]
    far = torch.diag(torch.tensor([1e-3, 1e3, 1.0])) @ torch.linalg.qr(matrices(1)[0]).Q
    return torch.stack([torch.eye(3), flat, torch.diag(torch.tensor([1.0, -2.0, 3.0])), far, 1e-6 * matrices(1)[0]])


@pytest.mark.parametrize("matrix", [matrices(200), special()], ids=["random", "special"])
def test_svd_has_orthogonal_factors_that_multiply_to_the_matrix(matrix: Tensor) -> None:
    u, values, vh = svd3(matrix)
    identity = torch.eye(3).expand_as(matrix)
    assert_close(u.transpose(1, 2) @ u, identity, atol=1e-5, rtol=0)
    assert_close(vh @ vh.transpose(1, 2), identity, atol=1e-5, rtol=0)
    size = matrix.abs().amax(dim=(1, 2), keepdim=True)
    assert_close((u * values[:, None]) @ vh / size, matrix / size, atol=1e-5, rtol=0)
    assert_close(values / size[:, 0], torch.linalg.svdvals(matrix) / size[:, 0], atol=1e-5, rtol=0)


def test_rigid_fits_are_those_of_torchs_svd(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    source, target = torch.randn(50, 30, 3, generator=generator), torch.randn(50, 30, 3, generator=generator)
    expected = fit_rigid(source, target + 3 * source)
    monkeypatch.setattr(torch.linalg, "svd", svd3)
    found = fit_rigid(source, target + 3 * source)
    for name in ("rotation", "shift"):
        assert_close(getattr(found, name), getattr(expected, name), atol=2e-5, rtol=0)
    flat = source * torch.tensor([1.0, 1.0, 0.0])
    mirrored = fit_rigid(flat, flat * torch.tensor([1.0, -1.0, 1.0]))
    assert_close(torch.linalg.det(mirrored.rotation), torch.ones(50), atol=1e-5, rtol=0)


def test_sampling_is_torchs_also_on_nodes_and_beyond_the_border() -> None:
    generator = torch.Generator().manual_seed(2)
    volume = torch.randn(1, 3, 5, 6, 7, generator=generator)
    places = 3 * torch.rand(1, 4, 25, 2, 3, generator=generator) - 1.5
    places[0, 0, :3, 0] = torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [0.0, 1.0, -1.0]])
    expected = F.grid_sample(volume, places, padding_mode="border", align_corners=True)
    assert_close(trilinear(volume, places, 0, 1, True), expected, atol=1e-5, rtol=0)


def random_motion(batch: int, seed: int = 0) -> Alignment:
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator))
    q = q * torch.diagonal(r, dim1=1, dim2=2).sign()[:, None]
    q[:, :, 2] *= torch.det(q).sign()[:, None]
    return Alignment(q, torch.randn(batch, 3, generator=generator))


@pytest.mark.parametrize("flatten", [1.0, 0.0])
def test_fit_finds_the_motion_that_was_made(flatten: float) -> None:
    """Also of flat clouds, whose mirror image is as near; in bfloat16 coordinates stay what they are."""
    motion = random_motion(8)
    cloud = random_points(8, 50, 1) * torch.tensor([1.0, 1.0, flatten])
    moved = motion.apply(cloud)
    found = fit_rigid(cloud, moved)
    assert torch.allclose(found.rotation, motion.rotation, atol=1e-5)
    assert torch.allclose(found.shift, motion.shift, atol=1e-5)
    ahead = motion.apply(cloud + 0.5) - moved
    assert torch.allclose(motion.turn_back(ahead), torch.full_like(cloud, 0.5), atol=1e-5)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(motion.apply(cloud), moved)
        assert torch.allclose(fit_rigid(cloud, moved).apply(cloud), moved, atol=1e-5)


def test_a_moved_object_gets_the_same_answers_turned_along() -> None:
    torch.manual_seed(0)
    network = Network(TINY.changed(sight_neighbors=0), segments=3).train()
    cloud, queries = random_points(2, TINY.points, 1), random_points(2, 30, 1)
    viewpoint = torch.tensor([[0.0, 0.0, -8.0]] * 2)
    network(cloud, viewpoint, queries)
    network.eval()
    motion = random_motion(2)
    rest_cloud, rest_queries = motion.apply(cloud), motion.apply(queries)
    with torch.inference_mode():
        plain = network.query(network._encode(rest_cloud, viewpoint, None), rest_queries)
        turned = network.query(network._encode(cloud, viewpoint, motion), queries)
    assert torch.allclose(plain.logits, turned.logits, atol=1e-4)
    assert torch.allclose(plain.distance, turned.distance, atol=1e-4)
    assert torch.allclose(plain.direction @ motion.rotation, turned.direction, atol=1e-4)


def test_loss_is_the_mean_distance_inside() -> None:
    """And zero, not NaN, for a scene whose deformation cannot be inverted."""
    rest = torch.zeros(1, 4, 3)
    rest[0, 2:] = torch.nan
    predicted = torch.tensor([[[3.0, 0, 4.0], [0, 1.0, 0], [9.0, 9.0, 9.0], [0, 0, 0]]], requires_grad=True)
    loss = rest_loss(predicted, rest)
    loss.backward()  # type: ignore[no-untyped-call]
    assert torch.isclose(loss, torch.tensor(3.0), atol=1e-3)
    assert torch.isfinite(predicted.grad).all() and (predicted.grad[0, 2:] == 0).all()
    predicted = torch.randn(2, 5, 3, requires_grad=True)
    loss = rest_loss(predicted, torch.full((2, 5, 3), torch.nan))
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() == 0 and torch.isfinite(predicted.grad).all()
