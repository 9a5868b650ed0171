"""Measures and moving parts of the engine, each as it stands at crank angle 0.

The crankshaft lies along x through the origin, cylinders stand along +z, the open side looks to -y. Cylinder 1 is at
the timing end (-x), the flywheel at +x. At crank angle 0, pistons 1 and 4 are at the top and cylinder 1 fires.
"""

import numpy as np
from jaxtyping import Float
from manifold3d import Manifold

from mereo_objects._machine_parts import bolts, box, hull, plate, ring_of, shaft, toothed, turned, union, without

CYLINDERS = (-15.0, -5.0, 5.0, 15.0)
"""x of the cylinders' axes."""

MAINS = (-20.0, -10.0, 0.0, 10.0, 20.0)
"""x of the crankshaft's and of the camshaft's bearings."""

CRANK_RADIUS = 4.0
ROD_LENGTH = 12.0
PISTON_RADIUS = 4.0
CROWN = 3.8
"""Height from the piston pin up to the crown."""

THROWS = (1.0, -1.0, -1.0, 1.0)
"""At crank angle 0 the crank pins of these cylinders point up (1) or down (-1)."""

CAM_HEIGHT = 30.6
CAM_BASE_RADIUS = 2.1
LIFT = 1.2
CAM_HALF_ANGLE = float(np.deg2rad(75.0))
"""A lobe acts within this angle, of the camshaft, before and after its nose."""

TAPPET_TOP = CAM_HEIGHT - CAM_BASE_RADIUS - 0.12
"""Of a closed valve: 0.12 of play under the base circle."""

INTAKE_AT = -2.05
INTAKE_RADIUS = 1.7
EXHAUST_AT, EXHAUST_RADIUS = 2.25, 1.5
"""Place along x from the cylinder's axis, and radius of the valve's head."""

VALVE_FACE = 21.0
STEM_RADIUS = 0.75
TAPPET_RADIUS = 1.6


def cam_lift(angle_rad: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Lift of a flat tappet when the lobe's nose is ``angle_rad`` of the camshaft away from it, in either direction.

    ``LIFT (1 - t^2)^2`` with t = angle / ``CAM_HALF_ANGLE``: it starts and ends without a jump in speed.
    """
    t = (np.remainder(angle_rad + np.pi, 2 * np.pi) - np.pi) / CAM_HALF_ANGLE
    return LIFT * np.maximum(1.0 - t * t, 0.0) ** 2


def _lobe_outline(nose_rad: float) -> list[tuple[float, float]]:
    """A lobe in (y, z) with its nose ``nose_rad`` about x from straight down (-z).

    A convex shape whose support in direction a is p(a) touches a flat tappet there at distance p; its outline is
    ``p n + p' t``. So the outline below has exactly the lift law, and is convex as ``p + p'' > 0`` (0.5 at the nose).
    """
    angle = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    step = 1e-4
    support = CAM_BASE_RADIUS + cam_lift(angle)
    slope = (cam_lift(angle + step) - cam_lift(angle - step)) / (2 * step)
    direction = angle + nose_rad
    # about +x, -z turns towards +y
    normal = np.stack([np.sin(direction), -np.cos(direction)], axis=1)
    tangent = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    outline = support[:, None] * normal + slope[:, None] * tangent
    return [(float(y), float(z)) for y, z in outline]


def camshaft(noses_rad: dict[float, float]) -> Manifold:
    """Shaft, bearing collars, one lobe at each x of ``noses_rad`` and the toothed belt wheel with its spokes."""
    shaft_part = shaft("x", (-24.2, 0, 0), 45.5, 1.4, sides=16)
    journals = [shaft("x", (x - 1.2, 0, 0), 2.4, 1.7, sides=16) for x in MAINS]
    lobes = [plate("x", _lobe_outline(nose), x - 1.0, x + 1.0) for x, nose in noses_rad.items()]
    wheel = toothed("x", (-24.0, 0, 0), 2.2, 4.0, teeth=20, depth=0.5)
    dish = shaft("x", (-24.1, 0, 0), 0.7, 3.0, sides=16)
    spokes = [shaft("x", (-26, y, z), 4.5, 0.75, sides=8) for _, y, z in ring_of("x", (0, 0, 0), 2.2, 5)]
    hub = union(shaft("x", (-24.5, 0, 0), 2.0, 1.4, sides=12), shaft("x", (-25.0, 0, 0), 1.0, 0.6, sides=6))
    parts = union(shaft_part, *journals, *lobes, without(wheel, dish, *spokes), hub)
    return parts.translate((0, 0, CAM_HEIGHT))


def crankshaft() -> Manifold:
    """Journals, four throws with counterweights, in front the belt wheel and a pulley, behind the toothed flywheel."""
    core = [shaft("x", (x - 2.5, 0, 0), 5.0, 2.0, sides=16) for x in MAINS]
    throws = [_throw(x, sign) for x, sign in zip(CYLINDERS, THROWS, strict=True)]
    front = union(
        shaft("x", (-26.0, 0, 0), 5.0, 1.2, sides=12),
        toothed("x", (-24.0, 0, 0), 2.2, 2.2, teeth=10, depth=0.5),
        turned(
            "x",
            (-26.1, 0, 0),
            [(0, 3.4), (0.3, 3.4), (0.6, 2.8), (0.9, 3.4), (1.2, 2.8), (1.5, 3.4), (1.8, 3.4)],
            16,
        ),
        shaft("x", (-26.7, 0, 0), 1.0, 0.8, sides=6),
    )
    disc = union(
        shaft("x", (22.6, 0, 0), 2.2, 7.2, sides=24), toothed("x", (23.0, 0, 0), 1.2, 7.8, teeth=30, depth=0.6)
    )
    recess = turned("x", (24.1, 0, 0), [(0.0, 5.0), (1.0, 6.2)], 24)
    holes = [shaft("x", (22, y, z), 5, 0.8, sides=8) for _, y, z in ring_of("x", (0, 0, 0), 3.9, 6)]
    flange = union(
        shaft("x", (21.6, 0, 0), 3.2, 2.6, sides=16), bolts("x", ring_of("x", (24.8, 0, 0), 1.8, 6), 0.4, 0.45)
    )
    return union(*core, *throws, front, without(disc, recess, *holes), flange)


def _throw(x: float, sign: float) -> Manifold:
    """A crank pin between two webs, each with a counterweight on the far side."""
    pin = shaft("x", (x - 1.8, 0, CRANK_RADIUS), 3.6, 1.5, sides=16)
    arm = hull(shaft("x", (-0.95, 0, CRANK_RADIUS), 1.9, 2.1, sides=16), shaft("x", (-0.95, 0, 0), 1.9, 2.7, sides=16))
    sector = [(5.8 * np.sin(a), -5.8 * np.cos(a)) for a in np.linspace(-1.05, 1.05, 10)]
    weight = plate("x", [*sector, (2.6, 0.6), (-2.6, 0.6)], -0.95, 0.95)
    web = union(arm, weight)
    throw = union(pin, web.translate((x - 2.6, 0, 0)), web.translate((x + 2.6, 0, 0)))
    return throw if sign > 0 else throw.rotate((180.0, 0.0, 0.0))


def connecting_rod(number: int) -> Manifold:
    """Big end with a bolted cap, fluted shank, small end with an oil hole."""
    top = ROD_LENGTH
    big = shaft("x", (-1.45, 0, 0), 2.9, 2.45, sides=16)
    shoulders = box((-1.45, -2.45, -1.0), (1.45, 2.45, 1.0), 0.25)
    small = shaft("x", (-1.3, 0, top), 2.6, 1.5, sides=16)
    shank = plate("x", [(-1.6, 1.6), (1.6, 1.6), (1.15, top - 1.0), (-1.15, top - 1.0)], -1.1, 1.1)
    flutes = [
        plate("x", [(-0.9, 3.2), (0.9, 3.2), (0.65, top - 2.2), (-0.65, top - 2.2)], low, low + 0.5)
        for low in (-1.2, 0.7)
    ]
    cap_bolts = [shaft("z", (0, side * 2.0, -1.3), 2.6, 0.38, sides=6) for side in (-1, 1)]
    eyes = [shaft("x", (-2, 0, 0), 4, 1.65, sides=16), shaft("x", (-2, 0, top), 4, 0.9, sides=12)]
    # the cap's parting line
    parting = [box((-2, side * 2.1 - 0.6, -0.08), (2, side * 2.1 + 0.6, 0.08)) for side in (-1, 1)]
    lines = [line ^ union(box((-2, -3, -1), (-1.2, 3, 1)), box((1.2, -3, -1), (2, 3, 1))) for line in parting]
    oil_hole = shaft("z", (0, 0, top + 0.5), 2.0, 0.25, sides=6)
    rod = without(union(big, shoulders, small, shank, *cap_bolts), *flutes, *eyes, *lines, oil_hole)
    return rod.translate((CYLINDERS[number], 0, THROWS[number] * CRANK_RADIUS))


def piston(number: int) -> Manifold:
    """Crown with three ring grooves and valve pockets, slipper skirt, hollow inside, with its pin."""
    r = PISTON_RADIUS
    top = CROWN
    bottom = -2.0
    profile = [(bottom, r - 0.05)]
    for groove in (-1.9, -1.2, -0.5):
        height = top + groove
        profile += [(height - 0.3, r), (height - 0.3, r - 0.35), (height, r - 0.35), (height, r)]
    body = turned("z", (0, 0, 0), [*profile, (top, r)], 18)
    hollow = turned("z", (0, 0, 0), [(bottom - 1, 3.2), (0.9, 3.2), (top - 1.9, 2.6)], 12)
    pockets = [
        shaft("z", (at, 0, top - 0.3), 1.0, radius + 0.05, sides=10)
        for at, radius in ((INTAKE_AT, INTAKE_RADIUS), (EXHAUST_AT, EXHAUST_RADIUS))
    ]
    sides = [box((side * 4.4 - 1.1, -3.0, bottom - 1), (side * 4.4 + 1.1, 3.0, 0.0)) for side in (-1, 1)]
    shell = without(body, hollow, *pockets, *sides)
    inner = shaft("z", (0, 0, bottom), 4.0, 3.6, sides=16)
    bosses = [
        union(shaft("x", (side * 1.5, 0, 0), side * 2.2, 1.35, sides=10), box(*block, 0.2)) ^ inner
        for side, block in ((-1, ((-3.7, -1.0, 0.0), (-1.5, 1.0, 2.2))), (1, ((1.5, -1.0, 0.0), (3.7, 1.0, 2.2))))
    ]
    pin = shaft("x", (-3.6, 0, 0), 7.2, 0.72, sides=12)
    part = union(shell, *bosses, pin)
    return part.translate((CYLINDERS[number], 0, THROWS[number] * CRANK_RADIUS + ROD_LENGTH))


def valve(radius: float, drop: float) -> Manifold:
    """Head, tulip, stem and bucket tappet, ``drop`` below the closed position; the axis is z."""
    face = VALVE_FACE
    profile = [
        (face, radius),
        (face + 0.45, radius),
        (face + 1.0, 0.65 * radius),
        (face + 1.9, STEM_RADIUS),
        (TAPPET_TOP - 1.9, STEM_RADIUS),
        (TAPPET_TOP - 1.9, TAPPET_RADIUS),
        (TAPPET_TOP, TAPPET_RADIUS),
    ]
    return turned("z", (0, 0, -drop), profile, 12)
