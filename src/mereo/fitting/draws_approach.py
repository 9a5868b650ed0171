"""Draws whose state has a given shape: Levenberg and Marquardt's method on few points, without looking at the frame.

The fit of the modes is dense and smooth, so the draws of a state like it are found from far away. Playing a state at few
points costs milliseconds; one set of differences serves for several steps (Broyden's rule).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mereo.fitting.gauss_newton import geman_mcclure
from mereo.fitting.playback import Drawn, Played
from mereo.geometry.procrustes import best_rotations
from mereo.scenes.scene import Scene

ROBUST = 2.5


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape to be met: positions of the played points, any pose, and the standard deviation of each."""

    points: Float[np.ndarray, "a 3"]
    std: Float[np.ndarray, " a"]
    worth: float

    @property
    def weight(self) -> Float[np.ndarray, " a"]:
        """Inverse variances, together worth as many points as ``worth``."""
        return self.worth / len(self.std) / self.std**2


@dataclass(frozen=True, eq=False)
class Near:
    """A state of a scene near a shape: its draws, played points, rigid motion onto the shape, and misfit."""

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    points: Float[np.ndarray, "a 3"]
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    misfit: float
    apart: float

    def offset(self, shape: Shape) -> Float[np.ndarray, "a 3"]:
        """Vectors from the shape to the state."""
        return self.points @ self.rotation.T + self.translation - shape.points


def near(scene: Scene, few: Played, shape: Shape, drawn: Drawn, z: Float[np.ndarray, " d"]) -> Near | None:
    """The state of these draws beside the shape; None where the scene refuses it."""
    deformations = drawn.deformations(scene, z)
    if deformations is None:
        return None
    points = few.moved(deformations)
    weight = shape.weight
    for _ in range(3):
        share = weight / weight.sum()
        center, goal = share @ points, share @ shape.points
        rotation = best_rotations(((points - center) * share[:, None]).T @ (shape.points - goal))
        translation = goal - rotation @ center
        distance = np.linalg.norm(points @ rotation.T + translation - shape.points, axis=1)
        weight = shape.weight * geman_mcclure(distance, ROBUST * np.maximum(shape.std, np.median(distance)))
    squared = (distance / shape.std) ** 2
    apart = float(shape.worth * (squared / (1 + squared / ROBUST**2 / 4)).mean())
    return Near(drawn, z, points, rotation, translation, apart + float(z @ z), apart)


def derivatives(scene: Scene, few: Played, here: Near, difference: float) -> Float32[np.ndarray, "a 3 d"]:
    """Motion of the played points for a standard deviation of each draw."""
    change = np.zeros((*here.points.shape, len(here.z)), dtype=np.float32)
    for number in np.flatnonzero(here.drawn.smooth):
        step = difference * (-1.0 if here.z[number] > 0 else 1.0)
        z = here.z.copy()
        z[number] += step
        moved = here.drawn.deformations(scene, z)
        if moved is not None:
            change[:, :, number] = (few.moved(moved) - here.points) / step
    return change


def secant(
    motion: Float32[np.ndarray, "a 3 d"], step: Float[np.ndarray, " d"], moved: Float[np.ndarray, "a 3"]
) -> Float32[np.ndarray, "a 3 d"]:
    """Derivatives that agree with what a step has really moved, otherwise changed least (Broyden's rule)."""
    missed = (moved - motion @ step.astype(np.float32)).astype(np.float32)
    return motion + missed[..., None] * (step / max(float(step @ step), 1e-12)).astype(np.float32)


def approach(scene, few, shape, here, fresh=2, steps=6, difference=0.02, log=None):
    """The state near the shape."""
    damping = 0.1
    for _ in range(fresh):
        motion = derivatives(scene, few, here, difference)
        for number in range(steps):
            found = None
            for _try in range(5):
                step = solve(shape, here, motion, damping)
                tried = near(scene, few, shape, here.drawn, here.z + step)
                if log is not None: log.append((tried is None, tried is not None and tried.misfit<here.misfit))
                if tried is not None:
                    motion = secant(motion, step, tried.points - here.points)
                if tried is not None and tried.misfit < here.misfit:
                    found = tried
                    break
                damping *= 5.0
            if found is None:
                break
            gain = here.misfit - found.misfit
            damping = max(damping / 4, 1e-3)
            here = found
            if gain < 0.02 * here.misfit:
                break
    return here


def solve(shape, here, motion, damping):
    offset = here.offset(shape)
    distance = np.linalg.norm(offset, axis=1)
    weight = shape.weight * geman_mcclure(distance, 2 * ROBUST * shape.std)
    turned = np.matmul(here.rotation.astype(np.float32), motion)
    arm = offset + shape.points - here.translation
    pose = np.zeros((*arm.shape, 6), dtype=np.float32)
    pose[:, :, 3:] = np.eye(3)
    pose[:, 0, 1], pose[:, 0, 2] = arm[:, 2], -arm[:, 1]
    pose[:, 1, 0], pose[:, 1, 2] = -arm[:, 2], arm[:, 0]
    pose[:, 2, 0], pose[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J = np.concatenate([pose, turned], axis=2).reshape(-1, 6 + motion.shape[2])
    W = np.repeat(weight, 3).astype(np.float32)
    H = ((J * W[:, None]).T @ J).astype(float)
    g = (J * W[:, None]).T.astype(float) @ offset.ravel()
    d = np.arange(6, len(g))
    H[d, d] += 1.0
    g[6:] += here.z
    H += np.diag(damping * np.maximum(np.diag(H), 1e-9)); H[d, d] += damping * 2
    dead = np.abs(motion).max(axis=(0, 1)) < 1e-9
    H[d, d] += np.where(dead, 1e9, 0)
    return -np.linalg.solve(H, g)[6:]
