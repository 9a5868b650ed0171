"""Deformations as maps of space."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float


@runtime_checkable
class Deformation(Protocol):
    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]: ...


@dataclass(frozen=True, eq=False)
class Compose:
    parts: tuple[Deformation, ...]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        for part in self.parts:
            points = part(points)
        return points


def invert(
    deformation: Deformation, points: Float[np.ndarray, "n 3"], guess: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    rest = guess.copy()
    h = 1e-4
    for _ in range(6):
        stack = np.concatenate([rest, *(rest + h * e for e in np.eye(3))])
        value = deformation(stack).reshape(4, -1, 3)
        residual = points - value[0]
        if np.abs(residual).max() < 1e-5:
            break
        jac = ((value[1:] - value[0]) / h).transpose(1, 2, 0)
        step = np.linalg.solve(jac, residual[..., None])[..., 0]
        norm = np.linalg.norm(step, axis=1, keepdims=True)
        rest = rest + step * np.minimum(1.0, 2.0 / np.maximum(norm, 1e-9))
    return rest, np.abs(points - deformation(rest)).max(axis=1) < 1e-3
