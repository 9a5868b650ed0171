"""The parts of the robot at rest: upright upper arm, forearm along +x, hand open; z is up, the floor is z = 0.

The arm is built in layers, so that neighbours pass each other at any angle. Shoulder, elbow, forearm and hand lie in
|y| <= 3.3, the upper arm beside them in y >= 3.5; inside the wrist's fork (1.8 <= |y|) the wrist has |y| <= 1.6. Faces
that turn upon each other are 0.2 apart.
"""

from itertools import pairwise

import numpy as np
from manifold3d import Manifold

from mereo_objects._machine_parts import bolts, box, plate, ring_of, shaft, turned, without
from mereo_objects._solids import Vector, hull, rod, union

SHOULDER: Vector = (3.5, 0.0, 19.0)
"""A point of the second axis, which is along y."""

ELBOW: Vector = (3.5, 0.0, 37.0)
"""A point of the third axis, which is along y."""

FOREARM_HEIGHT = 39.5
"""The fourth axis is along x at this height, 2.5 above the elbow; at rest the sixth continues it."""

WRIST: Vector = (21.5, 0.0, FOREARM_HEIGHT)
"""Where the fifth axis, along y, crosses the fourth."""

GAP = 0.2
JAW_OPENING = 1.1
"""Of each finger from the middle, at rest."""


def base() -> Manifold:
    """Foot with anchor bolts and stiffening ribs, round pedestal, socket box at the rear."""
    corner, edge = 6.5, 10.0
    outline = [(corner, -edge), (edge, -corner), (edge, corner), (corner, edge)]
    foot = plate("z", outline + [(-u, -v) for u, v in outline], 0.0, 1.8)
    pedestal = turned("z", (0, 0, 0), [(0.5, 7.4), (2.6, 7.4), (3.6, 6.4), (6.0, 6.0), (6.6, 7.2), (8.0, 7.2)], 32)
    ribs = [
        plate("y", [(1.0, 5.0), (1.0, 9.4), (2.4, 9.2), (6.2, 6.4), (6.2, 5.0)], -0.5, 0.5).rotate((0, 0, angle))
        for angle in (45, 90, 135, 225, 270, 315, 0)
    ]
    sockets = union(
        box((-9.6, -3.4, 1.0), (-5.0, 3.4, 6.4), 0.5),
        *(shaft("x", (-9.0, y, z), -1.6, 0.9, sides=12) for y, z in ((-1.7, 3.0), (1.7, 3.0), (0.0, 5.0))),
    )
    anchors = bolts("z", [(x, y, 1.8) for x in (-7.6, 7.6) for y in (-7.6, 7.6)], 0.9, 1.0)
    return union(foot, pedestal, *ribs, sockets, anchors)


def column() -> Manifold:
    """Turntable with bolts, shoulder casting, upright first motor, finned second motor lying across."""
    x, _, z = SHOULDER
    turntable = turned("z", (0, 0, 8.0 + GAP), [(0.0, 7.2), (1.3, 7.2), (1.7, 6.8), (2.0, 5.4)], 32)
    shoulder = shaft("y", (x, -4.2, z), 7.5, 4.3, sides=32)
    casting = hull(shaft("z", (0.3, 0, 8.6), 1.6, 5.6, sides=32), shoulder)
    # room for the upper arm, which swings beside the shoulder
    casting = without(casting, box((-9, 3.3, 14.0), (16, 12, 25)), shaft("y", (x, 3.3, z), 8.0, 5.0, sides=32))
    web_pocket = box((4.5, -1.6, 10.6), (12.0, 1.6, 13.6), 0.6)
    casting = without(casting, web_pocket)
    ring = bolts("z", ring_of("z", (0, 0, 9.6), 6.3, 12, 0.2), 0.45, 0.5)
    first = union(box((-6.5, -4.8, 9.6), (-2.0, -0.4, 15.4), 0.5), shaft("z", (-4.3, -2.6, 15.0), 1.4, 1.7, sides=16))
    fins = [shaft("y", (x, -5.0 - 0.9 * k, z), -0.45, 3.2, sides=20) for k in range(5)]
    second = union(
        shaft("y", (x, -4.0, z), -5.2, 2.6, sides=20), *fins, box((x - 1, -8.2, z + 2), (x + 1, -5.4, z + 3.9), 0.3)
    )
    cover = bolts("y", ring_of("y", (x, -4.2, z), 3.75, 8, 0.2), -0.4, 0.42)
    return union(turntable, casting, ring, first, second, cover)


def upper_arm() -> Manifold:
    """A cast beam beside the shoulder with a ribbed pocket, bolted hub covers and a cable clamp."""
    x, _, low = SHOULDER
    high = ELBOW[2]
    near, far = 3.5, 6.9
    beam = hull(
        shaft("y", (x, near, low), far - near, 4.2, sides=32), shaft("y", (x, near, high), far - near, 3.6, sides=28)
    )
    pocket = hull(
        shaft("y", (x, far - 1.5, low + 6.0), 3.0, 2.4, sides=16), shaft("y", (x, far - 1.5, high - 5.4), 3.0, 2.0)
    )
    ribs = [
        box((-4, far - 2.0, -0.35), (4, far - 0.3, 0.35)).rotate((0, angle, 0)).translate((x, 0, height))
        for height in (26.0, 30.0)
        for angle in (40.0, -40.0)
    ]
    beam = union(without(beam, pocket), *(rib ^ beam for rib in ribs))
    covers = [
        union(
            shaft("y", (x, far - 0.1, z), 0.7, radius, sides=24),
            bolts("y", ring_of("y", (x, far + 0.6, z), 0.78 * radius, count), 0.4, 0.42),
            shaft("y", (x, far, z), 1.2, 0.35 * radius, sides=16),
        )
        for z, radius, count in ((low, 3.4, 10), (high, 2.8, 8))
    ]
    clamp = box((x - 4.6, 4.2, 27.0), (x - 2.5, 6.2, 29.8), 0.3)
    return union(beam, *covers, clamp)


def elbow() -> Manifold:
    """Housing between the third and the fourth axis: bolted cover, three motors to the rear, a flange to the front."""
    x, _, z = ELBOW
    hub = shaft("y", (x, -3.3, z), 6.6, 3.7, sides=28)
    barrel = shaft("x", (x - 2.5, 0, FOREARM_HEIGHT), 7.0, 3.2, sides=28)
    cover = union(
        shaft("y", (x, -3.2, z), -0.7, 2.9, sides=24),
        bolts("y", ring_of("y", (x, -3.9, z), 2.25, 8), -0.4, 0.42),
    )
    motors = [
        union(
            shaft("x", (1.5, y, FOREARM_HEIGHT + dz), -6.0, 1.35, sides=16),
            box((-6.2, y - 0.9, FOREARM_HEIGHT + dz - 0.9), (-4.0, y + 0.9, FOREARM_HEIGHT + dz + 0.9), 0.25),
        )
        for y, dz in ((-1.75, -0.9), (1.75, -0.9), (0.0, 1.7))
    ]
    flange = union(
        shaft("x", (7.2, 0, FOREARM_HEIGHT), 1.8, 3.3, sides=28),
        bolts("x", ring_of("x", (7.2, 0, FOREARM_HEIGHT), 2.9, 10, 0.3), -0.9, 0.4),
    )
    box_on_top = box((2.0, -1.5, FOREARM_HEIGHT + 2.5), (5.6, 1.5, FOREARM_HEIGHT + 4.1), 0.4)
    return union(hull(hub, barrel), cover, *motors, flange, box_on_top)


def forearm() -> Manifold:
    """Tapered tube with ribs and a cable duct on one side; at its end a fork with bolted bearing caps."""
    wrist_x, _, z = WRIST
    tube = turned("x", (0, 0, z), [(9.2, 3.1), (10.3, 3.1), (10.8, 2.6), (16.0, 2.1), (17.0, 2.1)], 24)
    ribs = [
        plate("y", [(-3.0, 9.8), (3.0, 9.8), (2.2, 16.4), (-2.2, 16.4)], -0.3, 0.3).rotate((angle, 0, 0))
        for angle in (0.0, 45.0, 90.0, 135.0)
    ]
    duct = plate("y", [(0.0, 10.6), (3.1, 10.6), (3.1, 13.0), (2.4, 15.4), (0.0, 15.4)], -0.75, 0.75)
    ring = bolts("x", ring_of("x", (10.3, 0, 0), 2.72, 8, np.pi / 8), 0.4, 0.38)
    turning = union(*ribs, duct, ring).translate((0, 0, z))
    block = hull(
        box((16.2, -3.1, z - 1.9), (17.6, 3.1, z + 1.9), 0.4), shaft("y", (wrist_x, -3.1, z), 6.2, 1.9, sides=24)
    )
    slot = box((wrist_x - 2.5, -1.8, z - 5), (wrist_x + 5, 1.8, z + 5))
    caps = [
        union(
            shaft("y", (wrist_x, side * 3.0, z), side * 0.5, 1.5, sides=20),
            bolts("y", ring_of("y", (wrist_x, side * 3.5, z), 1.05, 6), side * 0.25, 0.25),
        )
        for side in (-1, 1)
    ]
    return union(tube, turning, without(block, slot), *caps)


def wrist() -> Manifold:
    """A drum in the fork with a neck and a collar towards the hand."""
    x, _, z = WRIST
    drum = shaft("y", (x, -1.6, z), 3.2, 2.2, sides=24)
    neck = shaft("x", (x, 0, z), 2.8, 1.6, sides=20)
    collar = shaft("x", (x + 2.5, 0, z), 1.1, 2.0, sides=24)
    plug = box((x + 1.0, -0.7, z + 1.0), (x + 2.9, 0.7, z + 1.95), 0.2)
    notches = bolts("x", ring_of("x", (x + 2.5, 0, z), 1.6, 6, 0.5), -0.3, 0.28)
    return union(drum, neck, collar, plug, notches)


def hand() -> Manifold:
    """Bolted flange, adapter, gripper housing with cooling slots, guide rails, a socket on top and a camera beside."""
    x = WRIST[0] + 3.6 + GAP
    z = FOREARM_HEIGHT
    flange = union(
        shaft("x", (x, 0, z), 0.8, 2.4, sides=24),
        shaft("x", (x + 0.5, 0, z), 1.5, 1.7, sides=20),
        bolts("x", ring_of("x", (x + 0.8, 0, z), 2.05, 6), 0.35, 0.27),
    )
    housing = box((x + 1.6, -3.9, z - 2.2), (x + 5.2, 3.9, z + 2.2), 0.4)
    slots = [
        box((x + 2.2 + 0.9 * k, side * 2.5 - 0.8, level - 0.35), (x + 2.65 + 0.9 * k, side * 2.5 + 0.8, level + 0.35))
        for k in range(3)
        for side in (-1, 1)
        for level in (z - 2.2, z + 2.2)
    ]
    rails = [box((x + 5.0, -3.9, z + dz - 0.35), (x + 5.6, 3.9, z + dz + 0.35)) for dz in (-1.2, 1.2)]
    socket = union(
        box((x + 2.2, -1.0, z + 1.8), (x + 4.6, 1.0, z + 3.3), 0.25), shaft("x", (x + 2.6, 0, z + 2.7), -1.3, 0.45)
    )
    return union(flange, without(housing, *slots), *rails, socket, hand_camera())


def hand_camera() -> Manifold:
    """The hand's own camera: it stands off beside the right finger, and its cable makes a bow over to the socket.

    It is what tells the fingers apart, so it stands out far enough for a depth image of 96 x 96 pixels, in which one
    pixel is about a unit. It is far enough forward to pass the forearm where the wrist is pitched all the way.
    """
    x = WRIST[0] + 3.6 + GAP
    z = FOREARM_HEIGHT
    y = -7.9
    bracket = box((x + 2.8, y + 1.0, z - 1.0), (x + 4.8, -3.5, z + 1.0), 0.2)
    body = box((x + 3.0, y - 1.6, z - 2.8), (x + 6.2, y + 1.6, z + 2.8), 0.4)
    lenses = [shaft("x", (x + 6.0, y, z + dz), 0.9, 0.8, sides=16) for dz in (-1.5, 1.5)]
    bow = [(y, 2.5), (y + 0.2, 4.6), (y + 1.4, 6.0), (y + 3.2, 6.3), (y + 5.0, 5.6), (-1.4, 3.9), (-0.6, 2.7)]
    course: list[Vector] = [(x + 4.0, across, z + up) for across, up in bow]
    cable = [rod(start, end, 0.55, 0.55, sides=8) for start, end in pairwise(course)]
    return union(bracket, body, *lenses, *cable)


def finger(side: int) -> Manifold:
    """A jaw on its carriage; ``side`` is +1 for +y and -1 for -y. The gripping face is notched for round bars."""
    x = WRIST[0] + 3.6 + GAP + 5.6 + 0.15
    z = FOREARM_HEIGHT
    inner = JAW_OPENING
    carriage = box((x, inner, z - 1.9), (x + 1.8, inner + 2.4, z + 1.9), 0.2)
    tip, back = x + 6.6, inner + 2.0
    blade = plate(
        "z",
        [(x + 1.0, inner), (tip, inner), (tip, inner + 1.3), (x + 3.4, back), (x + 1.0, back)],
        z - 1.5,
        z + 1.5,
    )
    notches = [
        plate("z", [(x + at - 0.5, inner - 0.1), (x + at + 0.5, inner - 0.1), (x + at, inner + 0.6)], z - 2, z + 2)
        for at in (2.6, 4.0, 5.4)
    ]
    screws = bolts("z", [(x + 0.9, inner + 0.7, z + 1.9), (x + 0.9, inner + 1.7, z + 1.9)], 0.3, 0.35)
    jaw = union(without(union(carriage, blade), *notches), screws)
    return jaw if side > 0 else jaw.rotate((180.0, 0.0, 0.0)).translate((0.0, 0.0, 2 * z))
