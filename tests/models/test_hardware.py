"""Which precision is chosen, and by what of the processor."""

import pytest
import torch

from mereo.models import device
from mereo.models.device import bfloat16_pays, pick_precision

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("features", "is_amd", "chosen"),
    [
        ({"amx": True, "avx512_bf16": True}, False, torch.bfloat16),
        ({"amx": False, "avx512_bf16": True}, True, torch.bfloat16),
        ({"amx": False, "avx512_bf16": True}, False, None),
        ({"amx": None, "avx512_bf16": None}, True, None),
    ],
)
def test_auto_takes_bfloat16_where_the_processor_gains_by_it(
    monkeypatch: pytest.MonkeyPatch, features: dict[str, bool | None], is_amd: bool, chosen: torch.dtype | None
) -> None:
    monkeypatch.setattr(device, "cpu_features", lambda: features)
    monkeypatch.setattr(device, "is_amd", lambda: is_amd)
    bfloat16_pays.cache_clear()
    try:
        assert pick_precision("auto", CPU) == chosen
        assert pick_precision("float32", CPU) is None
        assert pick_precision("bfloat16", CPU) == torch.bfloat16
    finally:
        bfloat16_pays.cache_clear()
