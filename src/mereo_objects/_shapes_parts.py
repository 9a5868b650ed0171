"""The solids of the scene Shapes, each standing on z = 0 about the z axis; lengths in scene units.

None is as symmetrical as it looks at first: a notch, a cut corner or a bump tells how far it is turned.
"""

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold

from mereo_objects._solids import ball, revolved

POST_RADIUS, POST_HEIGHT = 2.5, 15.5
RING_RADIUS, RING_TUBE = 4.6, 1.3
CONE_RADIUS, CONE_HEIGHT = 3.6, 6.0
BOX_SIZE = (6.2, 5.2, 4.6)
BALL_RADIUS = 2.9
STAR_RADIUS, STAR_HEIGHT = 3.8, 7.0
WEDGE_SIZE = (7.4, 4.6, 5.0)
ARCH_RADIUS, ARCH_HOLE, ARCH_LEG, ARCH_DEPTH = 4.0, 2.1, 2.0, 3.2


def _prism(outline: Float[np.ndarray, "n 2"], height: float) -> Manifold:
    """An upright prism; its walls are divided in height, so that they can twist."""
    return Manifold.extrude(CrossSection([outline]), height, int(height / 1.1))


def _polar(radius: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """An outline from its radii at equal steps of angle."""
    angle = 2 * np.pi * np.arange(len(radius)) / len(radius)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def post() -> Manifold:
    """A column with eight flutes, of which one is missing."""
    radius = np.where(np.arange(32) % 4 == 0, POST_RADIUS - 0.45, POST_RADIUS)
    radius[4] = POST_RADIUS
    return _prism(_polar(radius), POST_HEIGHT)


def ring() -> Manifold:
    """A torus about z at z = 0, with a bump like the stone of a finger ring at +x."""
    angle = 2 * np.pi * np.arange(14) / 14
    profile = np.stack([RING_RADIUS + RING_TUBE * np.cos(angle), RING_TUBE * np.sin(angle)], axis=1)
    return revolved(profile, 32) + ball((RING_RADIUS + 0.25, 0.0, 0.0), 1.65, 16)


def cone() -> Manifold:
    """A cone with a rim, a blunt tip and two notches in the rim."""
    profile = np.array(
        [(0.0, 0.0), (CONE_RADIUS, 0.0), (CONE_RADIUS, 0.8), (2.8, 1.0), (0.3, CONE_HEIGHT), (0.0, CONE_HEIGHT)]
    )
    notch = Manifold.cube((2.0, 1.2, 4.0), True)
    notches = notch.translate((CONE_RADIUS, 0.0, 0.0)) + notch.translate((CONE_RADIUS, 0.0, 0.0)).rotate((0, 0, 110))
    return revolved(profile, 24) - notches


def box() -> Manifold:
    """A block with a groove around it and one vertical edge cut off."""
    x, y, z = BOX_SIZE
    block = Manifold.cube((x, y, z), True)
    waist = Manifold.cube((x + 2, y + 2, 0.9), True) - Manifold.cube((x - 0.9, y - 0.9, 2.0), True)
    corner = Manifold.cube((3.0, 3.0, 2 * z), True).rotate((0, 0, 45)).translate((x / 2 + 0.4, y / 2 + 0.4, 0.0))
    return (block - waist - corner).translate((0.0, 0.0, z / 2))


def facetted_ball() -> Manifold:
    """A sphere with flats on ten of a dodecahedron's twelve sides; the two that lack one are not opposite."""
    golden = (1 + 5**0.5) / 2
    four = np.array([(0.0, s, t * golden) for s in (-1, 1) for t in (-1, 1)])
    normals = np.concatenate([np.roll(four, shift, axis=1) for shift in (0, 2, 1)]) / np.hypot(1.0, golden)
    solid = Manifold.sphere(BALL_RADIUS, 24)
    for normal in normals[2:]:
        solid = solid.trim_by_plane(tuple(-normal), -0.92 * BALL_RADIUS)
    return solid.translate((0.0, 0.0, BALL_RADIUS))


def star() -> Manifold:
    """A prism with five points, one of them blunt."""
    radius = np.where(np.arange(10) % 2 == 0, STAR_RADIUS, 0.5 * STAR_RADIUS)
    radius[0] *= 0.78
    return _prism(_polar(radius), STAR_HEIGHT)


def wedge() -> Manifold:
    """A ramp along x with three steps cut into its upper half: its mirror image is another solid."""
    x, y, z = WEDGE_SIZE
    outline = [(0.0, 0.0), (x, 0.0), (x, z), (x - 1.5, z), (x - 1.5, z - 1.2), (x - 3.0, z - 1.2), (x - 3.0, z - 2.4)]
    side = Manifold.extrude(CrossSection([np.array(outline)]), y, 3).rotate((90.0, 0.0, 0.0))
    slant = side.translate((-x / 2, y / 2, 0.0))
    return slant.trim_by_plane((0.0, 0.5, -1.0), -0.95 * z + 0.5)


def arch() -> Manifold:
    """A round arch across the y axis on two legs, one of them with a foot."""
    outer, hole, leg = ARCH_RADIUS, ARCH_HOLE, ARCH_LEG
    angle = np.linspace(0.0, np.pi, 17)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline = np.concatenate([[(outer, 0.0)], arc * outer + (0, leg), [(-outer, 0.0), (-hole, 0.0)]])
    outline = np.concatenate([outline, arc[::-1] * hole + (0, leg), [(hole, 0.0)]])
    solid = Manifold.extrude(CrossSection([outline]), ARCH_DEPTH, 2).rotate((90.0, 0.0, 0.0))
    foot = Manifold.cube((1.9, 0.9, 1.2)).translate((hole, ARCH_DEPTH / 2, 0.0))
    return solid.translate((0.0, ARCH_DEPTH / 2, 0.0)) + foot
