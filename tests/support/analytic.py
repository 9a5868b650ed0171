"""Closed-form fields of class logits, and a model that answers with one: for tests of everything behind the network."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray
from numpy.linalg import norm
from scipy.special import softmax

from mereo.geometry.conventions import Names, Triple
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.trained import Answer, EncodedCloud
from mereo_learning.config import PRESETS

Points = ndarray
Field = Callable[[Points], ndarray]
Distance = Field
"""Signed distance, negative inside."""


def ball(center: Triple, radius: float) -> Distance:
    return lambda points: norm(points - np.asarray(center), axis=1) - radius


def plate(normal: Triple, offset: float, thickness: float) -> Distance:
    unit = np.asarray(normal) / norm(normal)
    return lambda points: np.abs(points @ unit - offset) - thickness / 2


def half(distance: Distance, side: float) -> Distance:
    """The part with x < 0 (side -1) or x > 0 (side 1)."""
    return lambda points: np.maximum(distance(points), -side * points[:, 0])


def union(*distances: Distance) -> Distance:
    return lambda points: np.min([distance(points) for distance in distances], axis=0)


def logits_of(*distances: Distance, sharpness: float = 1.0) -> Field:
    """Segment k's logit is minus its distance, that of empty space the least distance."""

    def field(points: Points) -> ndarray:
        values = np.stack([distance(points) for distance in distances], axis=1)
        return sharpness * np.concatenate([values.min(axis=1, keepdims=True), -values], axis=1)

    return field


def tiny_network(segments: int, seed: int = 0) -> Network:
    """Not trained."""
    torch.manual_seed(seed)
    return Network(PRESETS["tiny"].network, segments).eval().requires_grad_(False)


def untrained(names: Names, scene: str = "rope", seed: int = 0) -> Model:
    return Model(tiny_network(len(names), seed), names, PALETTE[: len(names)], provenance={"scene": scene})


@dataclass(frozen=True, eq=False)
class AnalyticModel(Model):
    """Encodes as any model does, but answers with a field in the user's frame, or in the network's (``normalized``)."""

    field: Field = np.zeros_like
    normalized: bool = False

    @classmethod
    def of(cls, field: Field, names: Names, normalized: bool = False) -> "AnalyticModel":
        return cls(tiny_network(len(names)), names, PALETTE[: len(names)], field=field, normalized=normalized)

    def logits(self, code: EncodedCloud, points: Points) -> ndarray:
        return self.field(code.normalizer.apply(points) if self.normalized else points).astype(np.float32)

    def query(self, code: EncodedCloud, points: Points) -> Answer:
        logits = self.logits(code, points)
        nowhere = np.zeros((len(points), 3), np.float32)
        label = logits.argmax(axis=1).astype(np.uint8)
        return Answer(label, softmax(logits, axis=1), nowhere[:, 0], nowhere)


def oracle(mesh: SegmentedMesh, shift: Triple = (0.0, 0.0, 0.0)) -> AnalyticModel:
    """Knows the truth of two segments, moved by ``shift``."""
    solids = Solids(mesh)
    return AnalyticModel.of(lambda points: 5.0 * np.eye(3)[solids.label(points - shift)], mesh.names)
