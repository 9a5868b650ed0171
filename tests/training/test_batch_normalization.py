"""Batch normalization that processes share: torch's own where there is one process, and more exact than its CPU kernel.

With several processes it is in `test_nodes.py`.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import nn

from mereo.training.processes import Process, SharedBatchNorm, share_statistics

CPU = torch.device("cpu")


@pytest.fixture
def group(tmp_path: Path) -> Iterator[None]:
    """Group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'meet'}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def learnt(norm: nn.Module, rows: torch.Tensor, gradient: torch.Tensor) -> list[torch.Tensor]:
    """Outputs, all gradients, and running statistics of a step."""
    rows = rows.clone().requires_grad_()
    out = norm(rows)
    out.backward(gradient)
    assert isinstance(norm, nn.BatchNorm1d) and rows.grad is not None
    assert norm.weight.grad is not None and norm.bias.grad is not None
    assert norm.running_mean is not None and norm.running_var is not None
    found = [out, rows.grad, norm.weight.grad, norm.bias.grad, norm.running_mean, norm.running_var]
    return [value.detach().double() for value in found]


@pytest.mark.usefixtures("group")
@pytest.mark.parametrize("spreads", [0.0, 10.0, 100.0])
def test_it_is_torchs_and_no_less_exact(spreads: float) -> None:
    rng = torch.Generator().manual_seed(0)
    rows = torch.randn(384, 8, generator=rng) + spreads * torch.randn(8, generator=rng)
    gradient, weight = torch.randn(384, 8, generator=rng), torch.rand(8, generator=rng) + 0.5

    def norm(dtype: torch.dtype, shared: bool) -> nn.Module:
        made = nn.BatchNorm1d(8, dtype=dtype)
        made.weight.data.copy_(weight)
        return share_statistics(nn.Sequential(made), Process(0, 2), CPU)[0] if shared else made  # type: ignore[index]

    truth = learnt(norm(torch.float64, False), rows.double(), gradient.double())
    ours, torchs = (learnt(norm(torch.float32, shared), rows, gradient) for shared in (True, False))
    for mine, theirs, value in zip(ours, torchs, truth, strict=True):
        error, other = ((found - value).norm() / value.norm() for found in (mine, theirs))
        assert error < 1e-6 + other


@pytest.mark.usefixtures("group")
def test_in_use_it_has_its_running_statistics_and_one_process_keeps_torchs() -> None:
    norm, rows = nn.BatchNorm1d(4), torch.rand(16, 4)
    shared = share_statistics(nn.Sequential(norm), Process(0, 2), CPU).eval()
    assert isinstance(norm, SharedBatchNorm) and norm.num_batches_tracked == 0
    assert torch.allclose(shared(rows), rows / (1 + norm.eps) ** 0.5)
    shared.train()(rows)
    assert norm.num_batches_tracked == 1 and list(norm.state_dict()) == list(nn.BatchNorm1d(4).state_dict())
    network = nn.Sequential(nn.BatchNorm1d(4))
    assert share_statistics(network, Process(), CPU) is network and type(network[0]) is nn.BatchNorm1d
