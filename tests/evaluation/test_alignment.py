"""Alignment with the rest pose: the fit is exact where it can be, and the network behind it cannot see the turn."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mereo.models.network import AlignmentNet, Network
from mereo.models.rigid_alignment import Alignment, fit_rigid
from mereo.training.config import PRESETS
from mereo.training.losses import rest_loss

TINY = PRESETS["tiny"].network


def random_motion(batch: int, seed: int = 0) -> Alignment:
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator))
    q = q * torch.diagonal(r, dim1=1, dim2=2).sign()[:, None]
    q[:, :, 2] *= torch.det(q).sign()[:, None]
    return Alignment(q, torch.randn(batch, 3, generator=generator))


def cloud_of(batch: int = 2, points: int = TINY.points) -> Tensor:
    return torch.rand(batch, points, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def test_fit_finds_the_motion_that_was_made() -> None:
    motion, cloud = random_motion(8), cloud_of(8, 50)
    found = fit_rigid(cloud, motion.apply(cloud))
    assert torch.allclose(found.rotation, motion.rotation, atol=1e-5)
    assert torch.allclose(found.shift, motion.shift, atol=1e-5)


def test_fit_is_least_squares_under_noise() -> None:
    """No small further turn or shift brings the points closer."""
    cloud = cloud_of(1, 80)
    target = random_motion(1).apply(cloud) + 0.2 * torch.randn(1, 80, 3, generator=torch.Generator().manual_seed(2))
    found = fit_rigid(cloud, target)
    best = (found.apply(cloud) - target).square().sum()
    for axis in torch.eye(3):
        for sign in (-0.02, 0.02):
            turn = torch.matrix_exp(sign * torch.linalg.cross(axis.expand(3, 3), torch.eye(3)))
            middle = found.apply(cloud).mean(dim=1)[:, None]
            turned = (found.apply(cloud) - middle) @ turn + middle
            assert (turned - target).square().sum() > best
            assert (found.apply(cloud) + sign * axis - target).square().sum() > best


def test_fit_never_mirrors() -> None:
    """The mirror image would fit a mirrored target exactly; a rotation must be found instead."""
    cloud = cloud_of(4, 60)
    found = fit_rigid(cloud, cloud * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.allclose(torch.det(found.rotation), torch.ones(4), atol=1e-5)


def test_flat_clouds_are_fitted_too() -> None:
    motion, cloud = random_motion(3), cloud_of(3, 40) * torch.tensor([1.0, 1.0, 0.0])
    found = fit_rigid(cloud, motion.apply(cloud))
    assert torch.allclose(found.apply(cloud), motion.apply(cloud), atol=1e-5)
    assert torch.allclose(torch.det(found.rotation), torch.ones(3), atol=1e-5)


def test_autocast_does_not_touch_coordinates() -> None:
    motion, cloud = random_motion(4), cloud_of(4, 50)
    moved = motion.apply(cloud)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(motion.apply(cloud), moved)
        assert torch.allclose(fit_rigid(cloud, moved).apply(cloud), moved, atol=1e-5)


def test_directions_turn_back() -> None:
    motion, cloud = random_motion(2), cloud_of(2, 9)
    ahead = motion.apply(cloud + 0.5) - motion.apply(cloud)
    assert torch.allclose(motion.turn_back(ahead), torch.full_like(cloud, 0.5), atol=1e-5)


def test_a_moved_object_gets_the_same_answers_turned_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the right alignment, the network cannot tell how the object was turned."""
    torch.manual_seed(0)
    network = Network(TINY.changed(sight_neighbors=0), segments=3).train()
    cloud, queries, viewpoint = cloud_of(), cloud_of(points=30), torch.tensor([[0.0, 0.0, -8.0]] * 2)
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
    rest = torch.zeros(1, 4, 3)
    rest[0, 2:] = torch.nan
    predicted = torch.tensor([[[3.0, 0, 4.0], [0, 1.0, 0], [9.0, 9.0, 9.0], [0, 0, 0]]], requires_grad=True)
    loss = rest_loss(predicted, rest)
    loss.backward()  # type: ignore[no-untyped-call]
    assert torch.isclose(loss, torch.tensor(3.0), atol=1e-3)
    assert predicted.grad is not None and torch.isfinite(predicted.grad).all()
    assert (predicted.grad[0, 2:] == 0).all()


def test_loss_without_rest_coordinates_is_zero() -> None:
    """A scene whose deformation cannot be inverted trains without this term, not into NaN."""
    predicted = torch.randn(2, 5, 3, requires_grad=True)
    loss = rest_loss(predicted, torch.full((2, 5, 3), torch.nan))
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() == 0 and predicted.grad is not None and torch.isfinite(predicted.grad).all()


@pytest.mark.slow
def test_aligner_learns_a_turned_object() -> None:
    """An asymmetric cloud in random orientations: after a few steps, most of the turn is found."""
    torch.manual_seed(0)
    shape = cloud_of(1, 128) * torch.tensor([1.0, 0.6, 0.3])
    shape = shape + torch.tensor([0.0, 0.4, 0.0]) * (shape[..., :1] > 0.2) + 0.3 * shape[..., :1].square()
    aligner = AlignmentNet(TINY.changed(align_points=128))
    optimizer = torch.optim.Adam(aligner.parameters(), lr=3e-3)

    def batch(seed: int) -> tuple[Tensor, Tensor]:
        rest = shape.expand(8, -1, -1)
        return replace(random_motion(8, seed), shift=torch.zeros(8, 3)).apply(rest), rest

    for step in range(80):
        cloud, rest = batch(step)
        loss = rest_loss(aligner(cloud, cloud).rest, rest)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    cloud, rest = batch(10_000)
    with torch.inference_mode():
        before = (cloud - rest).norm(dim=-1).mean()
        after = (aligner.eval()(cloud).alignment.apply(cloud) - rest).norm(dim=-1).mean()
    assert after < 0.4 * before
