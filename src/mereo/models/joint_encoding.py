"""Several clouds in one call of the encoder: what a GPU is made for, and a CPU gains next to nothing from.

clouds -normalize each-> one batch -encode-> Code of all -split-> EncodedCloud of each
"""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mereo.geometry.camera import PointCloud
from mereo.models.model import EncodedCloud, Model


def encode_all(model: Model, clouds: Sequence[PointCloud]) -> list[EncodedCloud]:
    """``Model.encode`` of each cloud, all in one call of the network; equal to it up to the rounding of its products.

    Raises ``ValueError`` as ``Model.encode`` does, for the first cloud that cannot be used.
    """
    if not clouds:
        return []
    prepared = [model.normalized_cloud(cloud) for cloud in clouds]
    points = torch.cat([ordered for ordered, _ in prepared])
    viewpoints = torch.from_numpy(np.stack([normalizer.viewpoint for _, normalizer in prepared]).astype(np.float32))
    with model.answering():
        code = model.inference.encode(points.to(model.device), viewpoints.to(model.device))
    return [
        EncodedCloud(_one(code, number), normalizer, normalizer.invert(_seen(ordered, len(cloud))))
        for number, ((ordered, normalizer), cloud) in enumerate(zip(prepared, clouds, strict=True))
    ]


def _seen(ordered: Tensor, count: int) -> np.ndarray:
    """Points that the network saw, without those that repeat others."""
    return ordered[0, :count].numpy().astype(np.float64)


def _one(value: Any, number: int) -> Any:
    """The part of a value that belongs to one cloud, still as a batch, of one."""
    if isinstance(value, Tensor):
        return value[number : number + 1]
    if isinstance(value, tuple):
        return tuple(_one(item, number) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{item.name: _one(getattr(value, item.name), number) for item in fields(value)})
    return value
