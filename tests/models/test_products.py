"""Products of layers by oneDNN: the same numbers, where nothing but numbers is asked for."""

import pytest
import torch
from torch.nn import functional as F

from mereo.models import device
from mereo.models.device import ROWS, linear, onednn_pays
from mereo_experiments.speed.roofline import count_operations


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rows oneDNN was asked for, as if it were faster here."""
    rows_of_each: list[int] = []
    onednn = device._by_onednn

    def by_onednn(rows: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        rows_of_each.append(rows.numel() // rows.shape[-1])
        return onednn(rows, weight, bias)

    monkeypatch.setattr(device, "_by_onednn", by_onednn)
    monkeypatch.setattr(device, "onednn_pays", lambda: True)
    return rows_of_each


def layer(inputs: int = 70, outputs: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    numbers = torch.Generator().manual_seed(0)
    return torch.randn(outputs, inputs, generator=numbers), torch.randn(outputs, generator=numbers)


def rows(count: int, inputs: int = 70) -> torch.Tensor:
    return torch.randn(1, count, inputs, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("biased", [True, False])
def test_products_are_torchs_own(asked: list[int], biased: bool) -> None:
    weight, bias = layer()
    with torch.inference_mode():
        for count in (ROWS, 2 * ROWS):
            found = linear(rows(count), weight, bias if biased else None)
            exact = F.linear(rows(count).double(), weight.double(), bias.double() if biased else None)
            torch.testing.assert_close(found.double(), exact, rtol=0, atol=1e-4)
    assert asked == [ROWS, 2 * ROWS]


def test_other_sizes_precisions_and_trainings_are_torchs(asked: list[int]) -> None:
    weight, bias = layer()
    with torch.inference_mode():
        assert torch.equal(linear(rows(ROWS + 1), weight, bias), F.linear(rows(ROWS + 1), weight, bias))
        linear(rows(ROWS).double(), weight.double())
        linear(rows(0), weight)
        with torch.autocast("cpu", torch.bfloat16):
            assert linear(rows(ROWS), weight).dtype == torch.bfloat16
    weight.requires_grad_()
    linear(rows(ROWS), weight, bias).sum().backward()
    assert weight.grad is not None and not asked


def test_the_processor_decides_and_no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    onednn_pays.cache_clear()
    try:
        for is_amd, missing, pays in ((True, False, True), (False, False, False), (True, True, False)):
            onednn_pays.cache_clear()
            monkeypatch.setattr(device, "is_amd", lambda is_amd=is_amd: is_amd)
            if missing:  # a private operator of torch, which may go
                monkeypatch.setattr(torch.ops, "mkldnn", object())
            assert onednn_pays() is pays
        with torch.inference_mode():
            weight, bias = layer()
            assert torch.equal(linear(rows(ROWS), weight, bias), F.linear(rows(ROWS), weight, bias))
    finally:
        onednn_pays.cache_clear()


def test_its_operations_are_counted(asked: list[int]) -> None:
    weight, _ = layer()
    with torch.inference_mode():
        assert count_operations(lambda: linear(rows(ROWS), weight)) == 2 * ROWS * 70 * 40
    assert asked == [ROWS]
