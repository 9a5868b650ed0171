"""Sheet: a rubber mat of six patches and a tab that waves, folds over itself and rolls up; modelled here.

Segments: `patch_a1` to `patch_a3` (the row at +y), `patch_b1` to `patch_b3`, and `tab`, a tongue with an eyelet at the
end of row a. The mat is 52 x 38 units and 1.7 thick, has a hem of 2.5 all round and grooves between its patches; three
patches have nine holes each, three have nine studs each on the upper side, as on a chessboard. At rest it is flat.

Degrees of freedom, in this order:

- up to two corners, 9 to 17 units deep, bend by 35 to 180 degrees about lines within 26 degrees of the diagonals'
  normals, with a radius of 2.7 to 9 units; five of six bend upwards;
- the sheet is swept along a plane curve in a random direction: gentle waves (curvature up to 0.05 per unit), and with
  them nothing more (1 of 10 states), one fold of 60 to 190 degrees (3.5), two folds in opposite senses (2.5), or a roll
  of 180 to 450 degrees from one edge (3). No curvature exceeds 0.42 per unit, so the Jacobian, 1 minus curvature times
  offset, stays above 0.3;
- a twist of up to 0.5 radians end to end, smooth waves of all space (gradient up to 0.18), a tilt of up to 0.3 radians.

Bends and sweep keep lengths in the middle surface. A state whose layers would touch is drawn again, of the same kind,
and so is one in which the sweep would press or stretch a corner that is already bent by more than 0.7, or two corners
meet. Six of seven states show some of the underside from above.

What makes it hard: layers hide each other and their undersides look the same; turned by half a turn the mat is the
same but for the tab and for holes that become studs. And it is thin: a perfect answer that is moved by half a cell of
the grid that scores it, along each axis, keeps an IoU of 0.77 and a mIoU of 0.74 (64 test views); the flat mat that is
moved through its thickness by as much, 0.295 units of its 59, keeps 0.72.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from mereo.deformation.draw_names import named, part, unchecked
from mereo.deformation.maps import Compose, Deformation, Rigid, smooth_step
from mereo.deformation.warps import Bend, CurveSweep, SmoothField, Twist
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects._sheet_parts import LARGEST_OFFSET, middle_points, rest_mesh

NODES = read_only(np.linspace(-42.0, 42.0, 169))
"""Stations along the sweep's curve; the sheet reaches 34 units from its middle."""

GENTLE = 0.05
KINDS = ("waves", "fold", "two folds", "roll")
KIND_SHARES = (0.1, 0.35, 0.25, 0.3)
FOLD_CURVATURE = (0.16, 0.37)
ROLL_PITCH = 3.9
"""Between the layers of a roll: their thickness, 2.5 at the hem, and air."""

CLEARANCE = 3.4
"""Least distance of middle points that are not neighbours. They are at most 1.9 apart in the sheet, so that layers
whose points keep this distance are 3.1 apart: more than the thickest places of two layers, 1.5 and 1.25, need."""

MOST_PRESSED = 0.7
"""Largest curvature of the sweep times distance from the middle surface: by so much space is pressed or stretched."""

NEIGHBOURS = 7.0
"""Points within this distance at rest may come closer: half of the tightest fold's circumference is 7.5."""

ATTEMPTS = 1000


class Profile(NamedTuple):
    """Curve by its curvature at ``NODES``, and the station that stays where it is, level."""

    curvature: Float[np.ndarray, " m"]
    anchor: float


def _fold(start: float, length: float) -> Float[np.ndarray, " m"]:
    """Curvature 1 over ``length``, with smooth ends that take 30 % each: its integral is 0.7 length."""
    ramp = 0.3 * length
    return smooth_step((NODES - start) / ramp) * (1.0 - smooth_step((NODES - start - length + ramp) / ramp))


def sample_profile(rng: np.random.Generator, kind: str, low: float, high: float) -> Profile:
    """Random waves and, by ``kind``, folds or a roll of a sheet that reaches from station ``low`` to ``high``."""
    wavelengths = named(rng, "wavelength").uniform(22.0, 60.0, size=(3, 1))
    phases = named(rng, "wave phase", "rad").uniform(0, 2 * np.pi, size=(3, 1))
    sizes = named(rng, "wave").uniform(-1, 1, size=(3, 1))
    waves = sizes * np.sin(2 * np.pi * NODES / wavelengths + phases)
    curvature = GENTLE / 3 * waves.sum(axis=0)
    bent: list[tuple[float, float]] = []  # from station to station
    if kind == "roll":
        angle = np.deg2rad(named(rng, "roll", "°").uniform(180.0, 450.0))
        radius = named(rng, "radius of the roll").uniform(2.7, 3.6)
        # a spiral whose radius grows by the pitch each turn, from its end inwards: r dr = -pitch / (2 pi) ds
        growth = ROLL_PITCH / (2 * np.pi)
        start = high - (radius * angle + growth * angle**2 / 2)
        inner = np.maximum(high - NODES, 0.0)
        curvature += smooth_step((NODES - start) / 5.0) / np.sqrt(radius**2 + 2 * growth * inner)
        bent = [(start, high)]
    elif kind != "waves":
        folds = ("place of the fold",) if kind == "fold" else ("place of a fold", "place of the other fold")
        places = np.sort(named(rng, folds).uniform(low + 6.0, high - 6.0, size=len(folds)))
        sign = 1.0 if named(rng, "folds upwards below 0.8").uniform() < 0.8 else -1.0
        for place in places:
            angle = np.deg2rad(named(rng, "fold", "°").triangular(60.0, 175.0, 190.0))
            peak = named(rng, "curvature of the fold").uniform(*FOLD_CURVATURE)
            length = angle / (0.7 * peak)
            curvature += sign * peak * _fold(place - length / 2, length)
            bent.append((place - length / 2, place + length / 2))
            sign = -sign
    return Profile(curvature, _widest_gap(low, high, bent))


def _widest_gap(low: float, high: float, bent: list[tuple[float, float]]) -> float:
    """Middle of the longest stretch that is not bent."""
    starts, ends = [low, *(end for _, end in bent)], [*(start for start, _ in bent), high]
    gaps = [end - start for start, end in zip(starts, ends, strict=True)]
    widest = int(np.argmax(gaps))
    return (starts[widest] + ends[widest]) / 2


def curve(profile: Profile) -> Float[np.ndarray, "m 3"]:
    """Points in the x-z plane at ``NODES``, through (anchor, 0, 0) with the tangent along x."""
    step = NODES[1] - NODES[0]
    angle = np.cumsum(profile.curvature) * step
    angle -= np.interp(profile.anchor, NODES, angle)
    middle = (angle[1:] + angle[:-1]) / 2
    moves = step * np.stack([np.cos(middle), np.zeros_like(middle), np.sin(middle)], axis=1)
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(moves, axis=0)])
    at_anchor = np.array([np.interp(profile.anchor, NODES, points[:, k]) for k in range(3)])
    return points - at_anchor + np.array([profile.anchor, 0.0, 0.0])


def sample_corner(rng: np.random.Generator, corner: int) -> Bend:
    """Random bend of one corner of the sheet (0 to 3), lifted or folded onto the sheet."""
    turn = named(rng, "direction", "rad").uniform(-0.45, 0.45)
    heading = np.arctan2(19.0, 26.0) * (-1) ** corner + np.pi * (corner // 2) + turn
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    start = float((_middle() @ axis).max()) - named(rng, "depth").uniform(9.0, 17.0)
    angle = np.deg2rad(named(rng, "bend", "°").triangular(35.0, 165.0, 180.0))
    radius = named(rng, "radius").uniform(2.7, 4.5 if angle > 2.0 else 9.0)
    side = 1.0 if named(rng, "upwards below 5/6").uniform() < 5 / 6 else -1.0
    return Bend(start * axis, axis, np.array([0.0, 0.0, side]), radius * angle, float(angle), LARGEST_OFFSET)


def _turned(heading: float) -> Rigid:
    return Rigid(np.array([0.0, 0.0, heading]), np.zeros(3), np.zeros(3))


@cache
def _middle() -> Float[np.ndarray, "k 3"]:
    return read_only(middle_points())


def _do_not_meet(corners: list[Bend]) -> bool:
    """Whether each bend moves only what none before it has moved, which lies flat."""
    moved = _middle()
    for bend in corners:
        taken = (moved - bend.origin) @ bend.axis > -LARGEST_OFFSET
        if (np.abs(moved[taken] - _middle()[taken]) > 1e-9).any():
            return False
        moved = bend(moved)
    return True


def _sample_corners(rng: np.random.Generator) -> list[Bend]:
    """None, one or two corners, bent one after the other."""
    order = named(rng, tuple(f"order of corner {corner}" for corner in range(4))).permutation(4)
    corners = []
    for corner in order[: named(rng, "corners").choice(3, p=[0.4, 0.4, 0.2])]:
        with part(rng, f"corner {corner}"):
            corners.append(sample_corner(rng, int(corner)))
    return corners


def sample_deformation(rng: np.random.Generator, kind: str) -> Deformation | None:
    """Random map of one state, its profile of one of ``KINDS``, or None where it is not to be used."""
    corners = _sample_corners(rng)
    heading = named(rng, "heading of the curve", "rad").uniform(0, 2 * np.pi)
    before = Compose((*corners, _turned(-heading)))
    flat = _turned(-heading)(_middle())
    lifted = before(_middle())
    with part(rng, "curve"):
        profile = sample_profile(rng, kind, float(flat[:, 0].min()), float(flat[:, 0].max()))
    curvature = np.abs(np.interp(lifted[:, 0], NODES, profile.curvature))
    pressed = curvature * (np.abs(lifted[:, 2]) + LARGEST_OFFSET)
    if pressed.max() > MOST_PRESSED or not _do_not_meet(corners):
        return None
    sweep = CurveSweep.through(NODES, curve(profile), np.array([0.0, 1.0, 0.0]), LARGEST_OFFSET)
    twist_rad = named(rng, "twist", "rad").uniform(-0.5, 0.5)
    twist = Twist(np.array([-35.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 70.0, twist_rad)
    with part(rng, "waves"):
        waves = SmoothField.sample(rng, named(rng, "strength").uniform(0.0, 0.18), (30.0, 60.0))
    tilt = Rigid(named(rng, "tilt", "rad").uniform(-0.18, 0.18, size=3), np.zeros(3), np.zeros(3))
    whole = Compose((before, sweep, _turned(heading), twist, waves, tilt))
    return whole if unchecked(rng) or is_clear(whole(_middle())) else None


def is_clear(moved: Float[np.ndarray, "k 3"]) -> bool:
    """Whether the sheet whose middle points are here keeps its layers apart."""
    close = cKDTree(moved).query_pairs(CLEARANCE, output_type="ndarray")
    rest = np.linalg.norm(_middle()[close[:, 0]] - _middle()[close[:, 1]], axis=1)
    return bool((rest < NEIGHBOURS).all())


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random map that moves all segments."""
    # drawn once: were it drawn with every attempt, folds and rolls, which are refused more often, would be rare
    kind = str(named(rng, "kind").choice(KINDS, p=KIND_SHARES))
    for _ in range(ATTEMPTS):
        deformation = sample_deformation(rng, kind)
        if deformation is not None:
            return (deformation,) * len(rest_mesh().segments)
    raise ValueError(f"no state of the sheet in {ATTEMPTS} draws keeps its layers apart: widen the bounds")


def scene() -> Scene:
    """Scene of the sheet; the paper's camera workspace above it."""
    workspace = Workspace(fov_rad=float(np.deg2rad(42.0)))
    return Scene("sheet", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
