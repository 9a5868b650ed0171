"""Which precision is chosen, and by what measurement."""

from collections.abc import Iterator

import pytest
import torch

from mereo.models import device
from mereo.models.device import BFLOAT16_PAYS, pick_precision

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def measured_anew() -> Iterator[None]:
    device.bfloat16_gain.cache_clear()
    yield
    device.bfloat16_gain.cache_clear()


@pytest.mark.parametrize(("gain", "chosen"), [(0.6, None), (1.0, None), (2.0, torch.bfloat16), (5.0, torch.bfloat16)])
def test_auto_takes_bfloat16_where_products_are_faster(
    monkeypatch: pytest.MonkeyPatch, gain: float, chosen: torch.dtype | None
) -> None:
    seconds = {torch.float32: 1.0, torch.bfloat16: 1 / gain}
    monkeypatch.setattr(device, "_seconds", lambda a, b: seconds[a.dtype])
    assert device.bfloat16_gain() == pytest.approx(gain)
    assert pick_precision("auto", CPU) == chosen
    assert pick_precision("float32", CPU) is None
    assert pick_precision("bfloat16", CPU) == torch.bfloat16


def test_the_gain_is_measured_once_and_a_disturbance_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([9.0, 1.0, 1.0, 9.0, *[1.0] * 12])  # one product of each kind was interrupted
    monkeypatch.setattr(device, "_seconds", lambda a, b: next(times))
    assert device.bfloat16_gain() == device.bfloat16_gain() == 1.0 < BFLOAT16_PAYS
