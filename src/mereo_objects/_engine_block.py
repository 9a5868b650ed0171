"""The engine's fixed part, cut open: above the oil pan it is sectioned lengthwise, and the half y < 0 is gone."""

from itertools import pairwise

from manifold3d import Manifold

from mereo_objects._engine_parts import (
    CAM_HEIGHT,
    CYLINDERS,
    EXHAUST_AT,
    EXHAUST_RADIUS,
    INTAKE_AT,
    INTAKE_RADIUS,
    MAINS,
    STEM_RADIUS,
    TAPPET_RADIUS,
)
from mereo_objects._machine_parts import Vector, bolts, box, hull, shaft, union, without

END = 21.3
"""Half of the block's length."""

REAR = 8.0
DECK = 20.0
CRANKCASE_TOP = 7.3
PAN_RIM = -6.6
CRANKCASE_RADIUS = 7.0
"""The rods' big ends sweep 6.6."""

BORE = 4.2
MAIN_BORE = 2.15
BULKHEAD = 1.0
"""Half the thickness of the walls that carry the main bearings."""

CHAMBER_ROOF = 21.7
HEAD_TOP = 26.8
HEAD_REAR = 7.4


def block() -> Manifold:
    """Cylinders with their water jacket, crankcase with bearing caps, oil pan, head with ports, camshaft bearings."""
    return union(_cylinders(), _crankcase(), _pan(), _head(), _details())


def _cylinders() -> Manifold:
    body = box((-END, 0, CRANKCASE_TOP - 0.2), (END, REAR, DECK))
    bores = [shaft("z", (x, 0, 5), 18.0, BORE, sides=24) for x in CYLINDERS]
    # the water jacket shows between the bores
    slots = [box((x - 0.45, -1, 10.0), (x + 0.45, 4.0, 18.0), 0.2) for x in MAINS[1:-1]]
    jackets = [box((side * 20.3 - 0.5, -1, 9.8), (side * 20.3 + 0.5, 6.5, 18.4)) for side in (-1, 1)]
    return without(body, *bores, *slots, *jackets)


def _crankcase() -> Manifold:
    """Rear wall and bulkheads; the bearing caps reach to the open side as well, as the pan below them does."""
    body = box((-END, 0, PAN_RIM), (END, REAR, CRANKCASE_TOP))
    bays = [
        hull(
            shaft("x", (left + BULKHEAD, 0, 0), right - left - 2 * BULKHEAD, CRANKCASE_RADIUS, sides=24),
            box((left + BULKHEAD, -7, PAN_RIM - 1), (right - BULKHEAD, CRANKCASE_RADIUS, 0)),
        )
        for left, right in pairwise(MAINS)
    ]
    under_caps = box((-END + 1.2, -1, PAN_RIM - 1), (END - 1.2, CRANKCASE_RADIUS, -3.4))
    openings = [shaft("z", (x, 0, 5), 5.0, BORE, sides=24) for x in CYLINDERS]
    caps = union(
        *(box((x - BULKHEAD, -3.6, -3.6), (x + BULKHEAD, 3.6, 0), 0.3) for x in MAINS),
        bolts("z", [(x, y, -3.6) for x in MAINS for y in (-2.8, 2.8)], -0.6, 0.55),
    )
    line = shaft("x", (-30, 0, 0), 60, MAIN_BORE, sides=20)
    return without(union(without(body, *bays, under_caps, *openings), caps), line)


def _pan() -> Manifold:
    """A tub under the whole engine, deeper towards the timing end, on a flange with bolts."""
    tub = union(
        hull(
            box((-END, -REAR, PAN_RIM - 1), (END, REAR, PAN_RIM)),
            box((-END + 0.6, -6.6, PAN_RIM - 2.6), (END - 0.6, 6.6, PAN_RIM)),
        ),
        hull(
            box((-END, -REAR, PAN_RIM - 1), (-2, REAR, PAN_RIM)),
            box((-END + 0.8, -6.2, PAN_RIM - 5.4), (-6, 6.2, PAN_RIM)),
        ),
    )
    flange = box((-END - 0.4, -REAR - 0.8, PAN_RIM - 0.6), (END + 0.4, REAR + 0.8, PAN_RIM))
    inside = union(
        box((-END + 1.2, -REAR + 1.2, PAN_RIM - 1.2), (END - 1.2, REAR - 1.2, PAN_RIM + 1)),
        box((-END + 2.0, -5.8, PAN_RIM - 1.8), (END - 2.0, 5.8, PAN_RIM)),
        box((-END + 2.0, -5.2, PAN_RIM - 4.4), (-7.2, 5.2, PAN_RIM)),
    )
    rim = bolts("z", [(-20.0 + 5.0 * k, -REAR, PAN_RIM) for k in range(9)], 0.45, 0.5)
    plug = shaft("y", (-13.0, -6.0, PAN_RIM - 4.2), -1.4, 0.8, sides=6)
    return union(without(union(tub, flange), inside), rim, plug)


def _head() -> Manifold:
    body = box((-END, 0, DECK), (END, HEAD_REAR, HEAD_TOP))
    valves = [
        (x + at, radius) for x in CYLINDERS for at, radius in ((INTAKE_AT, INTAKE_RADIUS), (EXHAUST_AT, EXHAUST_RADIUS))
    ]
    chambers = [
        hull(
            shaft("z", (x - 0.9, 0, DECK - 1), CHAMBER_ROOF - DECK + 1, 3.15, sides=16),
            shaft("z", (x + 1.15, 0, DECK - 1), CHAMBER_ROOF - DECK + 1, 2.85, sides=16),
        )
        for x in CYLINDERS
    ]
    guides = [shaft("z", (x, 0, 22), 4.0, STEM_RADIUS + 0.2, sides=10) for x, _ in valves]
    tappets = [shaft("z", (x, 0, 25.0), 5.0, TAPPET_RADIUS + 0.17, sides=16) for x, _ in valves]
    water = [box((x - 1.0, -2.0, 21.6), (x + 1.0, 6.0, 25.6), 0.4) for x in MAINS[1:-1]]
    return union(
        without(body, *chambers, *(_port(x, radius) for x, radius in valves), *guides, *tappets, *water),
        _cam_bearings(),
    )


def _port(x: float, radius: float) -> Manifold:
    """From the valve's seat up and round to the rear of the head."""
    narrow = radius - 0.4

    def ball(y: float, z: float) -> Manifold:
        return Manifold.sphere(narrow, 8).translate((x, y, z))

    throat = shaft("z", (x, 0, CHAMBER_ROOF - 0.1), 0.6, radius - 0.05, radius - 0.25, sides=16)
    bowl = hull(shaft("z", (x, 0, CHAMBER_ROOF + 0.4), 0.2, radius - 0.25, sides=14), ball(0.0, 23.0))
    return union(throat, bowl, hull(ball(0.0, 23.0), ball(9.5, 24.2)))


def _cam_bearings() -> Manifold:
    posts = [
        hull(
            box((x - BULKHEAD, 0, HEAD_TOP - 0.5), (x + BULKHEAD, 3.6, HEAD_TOP + 0.5)),
            box((x - BULKHEAD, 0, CAM_HEIGHT), (x + BULKHEAD, 3.2, CAM_HEIGHT + 2.5)),
        )
        for x in MAINS
    ]
    nuts = bolts("z", [(x, 2.2, CAM_HEIGHT + 2.5) for x in MAINS], 0.5, 0.55)
    return without(union(*posts, nuts), shaft("x", (-30, 0, CAM_HEIGHT), 60, 1.87, sides=20))


def _details() -> Manifold:
    """Head bolts, bolts and ribs of the end faces, the flange towards the gearbox."""
    head_bolts = bolts("z", [(x, 5.4, HEAD_TOP) for x in (*CYLINDERS, *MAINS[1:-1])], 0.6, 0.7)
    ends: list[Vector] = [(-END, y, z) for y, z in ((2.0, 9.2), (6.8, 9.2), (2.0, 18.6), (6.8, 18.6), (6.4, 25.6))]
    front = bolts("x", ends, -0.5, 0.55)
    gearbox = union(
        box((END - 0.5, 0, CRANKCASE_TOP - 2.0), (END + 0.9, REAR + 0.8, CRANKCASE_TOP + 2.6), 0.2),
        bolts("x", [(END + 0.9, y, CRANKCASE_TOP + 1.8) for y in (2.5, 6.5)], 0.4, 0.5),
    )
    return union(head_bolts, front, gearbox)
