"""A scene that needs no asset: a bar of three boxes and a ball on top, bent, stretched and turned.

Its maps are in closed form and its sampler is a plain function, so that worker processes can be given it.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from numpy.random import Generator
from shapes import ball, box

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.scene import Scene, Workspace


@dataclass(frozen=True, eq=False)
class Shear:
    """``(x + a sin(z / 9), y + b x, (1 + c) z)``: smooth, and its inverse is in closed form."""

    a: float
    b: float
    c: float

    def __call__(self, points: ndarray) -> ndarray:
        x, y, z = points.T
        return np.stack([x + self.a * np.sin(z / 9), y + self.b * x, (1 + self.c) * z], axis=1)

    def inverse(self, points: ndarray) -> ndarray:
        x, y, z = points.T
        z = z / (1 + self.c)
        x0 = x - self.a * np.sin(z / 9)
        return np.stack([x0, y - self.b * x0, z], axis=1)


@dataclass(frozen=True, eq=False)
class Lift:
    height: float
    then: Shear

    def __call__(self, points: ndarray) -> ndarray:
        return self.then(points + np.array([0.0, 0.0, self.height]))


def sample_deformations(rng: Generator) -> tuple[Deformation, ...]:
    shear = Shear(*(named(rng, "shear").uniform(-1, 1, size=3) * [3.0, 0.3, 0.2]))
    with part(rng, "ball"):
        lift = Lift(float(named(rng, "lift").uniform(0.5, 3.0)), shear)
    return (shear, shear, shear, lift)


def rest_mesh() -> SegmentedMesh:
    bar = [box((12 * i - 18, -6, -5), (12 * i - 6, 6, 5), f"box_{i}", i) for i in range(3)]
    return SegmentedMesh((*bar, ball((0, 0, 11.5), 6.0, "ball", 3, level=3)))


def toy_scene(**workspace: object) -> Scene:
    return Scene("toy", rest_mesh(), sample_deformations, Workspace(**workspace))  # type: ignore[arg-type]
