"""Engine: four cylinders in line, cut open lengthwise, turned by one crank angle; modelled here, needs no download.

Source: modelled in mereo's own code (`_engine_parts`, `_engine_block`), MIT licence; no particular product. It is 52 x
18 x 47 units: cylinders 10 apart, bore 8.4, stroke 8, rods 12 long.

Segments, twelve: `block` (cylinders, crankcase, pan and head in one), `crankshaft` with flywheel and pulley, `camshaft`
with its belt wheel, `valves` (all eight, with their bucket tappets), `rod_1` .. `rod_4`, `piston_1` .. `piston_4` with
their pins. Rods and pistons look alike, and which one is seen is the question, so each is a segment of its own. The
valves are one segment because each is only a pixel or two thick; one map moves each by its own lift.

Degrees of freedom: one, the crank angle, uniform over the two turns of the four-stroke cycle. It drives everything:

    crankshaft  turns about x
    rods        slider-crank: tilted by asin(4 sin(angle) / 12), at most 19.5 degrees
    pistons     their pins are 4 cos(angle) + sqrt(12^2 - (4 sin(angle))^2) above the crankshaft
    camshaft    turns half as fast
    valves      lift up to 1.2 by the flat-tappet law of the very lobes that are modelled (`cam_lift`): open for 300
                degrees of the crank, most 110 degrees before (exhaust) and after (intake) the top of the gas exchange

Cylinders fire in the order 1-3-4-2, cylinder 1 at angle 0. Parts that slide or turn upon each other are 0.1 to 0.2
apart at every angle: lobes and tappets, for example, always 0.12.

It makes fewer examples a second than the other scenes, about 4 per core: twelve segments have 3,533 query points, 2.4
times the bunny's, and its thin, nested parts need 87,000 draws to find them, eight times the bunny's.

What makes it hard: pistons 1 and 4 move alike, as do 2 and 3, and the same crank position occurs twice in a cycle with
other valves open; stems of 1.5 and walls of 1.6 are at the size of a pixel; rods, pins and cranks hide each other. On
the other hand one number decides everything, so what is hidden follows from what is seen.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Deformation, Identity, Rigid, smooth_step
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects import _engine_parts as parts
from mereo_objects._engine_block import block
from mereo_objects._machine_parts import segment, union

LONGEST_EDGE = 10.0
"""Longer edges are split: the block's slivers would nearly double the time to find nearest points on it."""

CYCLE_RAD = 4 * np.pi

FIRING_RAD = tuple(np.deg2rad(angle) for angle in (0.0, 540.0, 180.0, 360.0))
"""Crank angle at which cylinders 1 to 4 fire: the order is 1-3-4-2."""

INTAKE_PEAK_RAD = np.deg2rad(360.0 + 110.0)
EXHAUST_PEAK_RAD = np.deg2rad(360.0 - 110.0)
"""Crank angle from firing at which a cylinder's valve is open most."""


@dataclass(frozen=True, eq=False)
class StepwiseShift:
    """Shift of space along z by an amount that depends on x alone; its Jacobian is 1.

    Attributes:
        borders: ascending x between neighbouring steps.
        shifts: the amount on each step, one more than borders.
        width: over which the amount changes smoothly, about each border.
    """

    borders: Float[np.ndarray, " b"]
    shifts: Float[np.ndarray, " s"]
    width: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Shifted points."""
        past = smooth_step((points[:, :1] - self.borders) / self.width + 0.5)
        moved = points.copy()
        moved[:, 2] += self.shifts[0] + past @ np.diff(self.shifts)
        return moved


@cache
def valve_places() -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Places of the eight valves from front to rear: x, radius, and the crank angle at which they are open most."""
    rows = [
        (x + at, radius, firing + peak)
        for x, firing in zip(parts.CYLINDERS, FIRING_RAD, strict=True)
        for at, radius, peak in (
            (parts.INTAKE_AT, parts.INTAKE_RADIUS, INTAKE_PEAK_RAD),
            (parts.EXHAUST_AT, parts.EXHAUST_RADIUS, EXHAUST_PEAK_RAD),
        )
    ]
    x, radius, peak = read_only(np.array(rows)).T
    return x, radius, peak


def valve_lifts(crank_rad: float) -> Float[np.ndarray, " v"]:
    """Lift of each valve, in units."""
    return parts.cam_lift((crank_rad - valve_places()[2]) / 2)


@cache
def rest_mesh() -> SegmentedMesh:
    """Engine at crank angle 0."""
    x, radius, peak = valve_places()
    valves = [
        parts.valve(r, drop).translate((at, 0, 0)) for at, r, drop in zip(x, radius, valve_lifts(0.0), strict=True)
    ]
    solids = {
        "block": block(),
        "crankshaft": parts.crankshaft(),
        "camshaft": parts.camshaft({float(at): float(-angle / 2) for at, angle in zip(x, peak, strict=True)}),
        "valves": union(*valves),
        **{f"rod_{number + 1}": parts.connecting_rod(number) for number in range(4)},
        **{f"piston_{number + 1}": parts.piston(number) for number in range(4)},
    }
    colors = [PALETTE[7], *(PALETTE[i] for i in (0, 1, 3, 2, 4, 5, 6, 8, 9, 10, 11))]
    return SegmentedMesh(
        tuple(
            segment(name, color, part, LONGEST_EDGE) for (name, part), color in zip(solids.items(), colors, strict=True)
        )
    )


def rod_and_piston(crank_rad: float, throw: float) -> tuple[Deformation, Deformation]:
    """Motion of a rod and its piston from angle 0, for a crank pin that starts up (``throw`` 1) or down (-1)."""
    start = throw * parts.CRANK_RADIUS
    y, z = -start * np.sin(crank_rad), start * np.cos(crank_rad)
    tilt = np.arcsin(y / parts.ROD_LENGTH)
    rise = z + parts.ROD_LENGTH * np.cos(tilt) - (start + parts.ROD_LENGTH)
    rod = Rigid(np.array([tilt, 0.0, 0.0]), np.array([0.0, y, z - start]), np.array([0.0, 0.0, start]))
    return rod, Rigid(np.zeros(3), np.array([0.0, 0.0, rise]), np.zeros(3))


def deformations_at(crank_rad: float) -> tuple[Deformation, ...]:
    """Motions of all segments from angle 0 to ``crank_rad``; any angle, the cycle is 4 pi long."""
    x, radius, _ = valve_places()
    crank = Rigid(np.array([crank_rad, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    cam = Rigid(np.array([crank_rad / 2, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, parts.CAM_HEIGHT]))
    widest = np.maximum(radius, parts.TAPPET_RADIUS)
    gaps = np.stack([x[:-1] + widest[:-1], x[1:] - widest[1:]])
    valves = StepwiseShift(
        gaps.mean(axis=0), valve_lifts(0.0) - valve_lifts(crank_rad), float(np.diff(gaps, axis=0).min())
    )
    pairs = {throw: rod_and_piston(crank_rad, throw) for throw in set(parts.THROWS)}
    rods, pistons = zip(*(pairs[throw] for throw in parts.THROWS), strict=True)
    return (Identity(), crank, cam, valves, *rods, *pistons)


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Motions at a crank angle uniform over the cycle."""
    return deformations_at(named(rng, "crank angle", "rad").uniform(0.0, CYCLE_RAD))


def scene() -> Scene:
    """Scene of the engine; cameras stand before the open side, rather above than below."""
    workspace = Workspace(axis=(0.0, -0.94, 0.34), fov_rad=float(np.deg2rad(40.0)))
    return Scene("engine", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
