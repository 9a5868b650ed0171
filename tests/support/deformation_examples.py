"""One random deformation of every kind, and the points on which its bound holds."""

from collections.abc import Callable

import numpy as np

from mereo.deformation.maps import Compose, Deformation, Identity, Localized, Rigid
from mereo.deformation.warps import Bend, CurveSweep, FreeFormLattice, SmoothField, Squash, Taper, Twist

HALF = 10.0
"""The random points fill the cube [-HALF, HALF]^3."""

REACH = HALF * 3**0.5
BOX = np.array([[-HALF] * 3, [HALF] * 3])


def direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def make_rigid(rng: np.random.Generator) -> Deformation:
    return Rigid(rng.uniform(-2, 2, 3), rng.uniform(-5, 5, 3), rng.uniform(-5, 5, 3))


def make_bend(rng: np.random.Generator) -> Deformation:
    length = rng.uniform(5.0, 25.0)
    return Bend(np.zeros(3), direction(rng), direction(rng), length, rng.uniform(-0.9, 0.9) * length / REACH, REACH)


def make_twist(rng: np.random.Generator) -> Deformation:
    return Twist(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(4, 20), rng.uniform(-2, 2))


def make_taper(rng: np.random.Generator) -> Deformation:
    return Taper(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(4, 20), rng.uniform(0.4, 2.5))


def make_squash(rng: np.random.Generator) -> Deformation:
    return Squash(rng.uniform(-3, 3, 3), direction(rng), rng.uniform(0.4, 2.5))


def make_field(rng: np.random.Generator) -> SmoothField:
    return SmoothField.sample(rng, strength=0.9, wavelength=(8.0, 40.0))


def make_lattice(rng: np.random.Generator) -> FreeFormLattice:
    return FreeFormLattice.sample(rng, BOX, (4, 3, 2), strength=0.95)


def make_window(rng: np.random.Generator) -> Deformation:
    inner = Rigid(rng.uniform(-0.4, 0.4, 3), rng.uniform(-0.8, 0.8, 3), np.zeros(3))
    return Localized(inner, np.zeros(3), 2.0, 9.0)


def make_sweep(rng: np.random.Generator) -> Deformation:
    """A slice of a helix of curvature 0.9 / REACH at most, so that the whole cube stays within its reach."""
    nodes = np.linspace(-HALF, HALF, 81)
    radius, rise = REACH / 0.9, rng.uniform(0.0, 20.0)
    t = nodes / np.hypot(radius, rise)
    return CurveSweep.through(
        nodes, np.stack([radius * np.cos(t), radius * np.sin(t), rise * t], 1), direction(rng), REACH
    )


MAKERS: dict[str, Callable[[np.random.Generator], Deformation]] = {
    "identity": lambda rng: Identity(),
    "rigid": make_rigid,
    "bend": make_bend,
    "twist": make_twist,
    "taper": make_taper,
    "squash": make_squash,
    "field": make_field,
    "lattice": make_lattice,
    "window": make_window,
    "sweep": make_sweep,
    "composition": lambda rng: Compose((make_field(rng), make_rigid(rng), make_squash(rng), make_taper(rng))),
}


def cube(rng: np.random.Generator, count: int = 300) -> np.ndarray:
    return rng.uniform(*BOX, size=(count, 3))
