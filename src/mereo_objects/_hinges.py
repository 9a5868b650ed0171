"""Knuckle joints of toys that are printed in one piece: a knob in a socket, and a V-shaped opening to turn in.

Seen from above, ``heading`` runs from the socket's link to the knob's. The knob's link has a sector about that
direction with its tip at the pivot, and the knob: a double cone, widest at half height, which the socket holds down.
The socket's link has what lies outside a wider sector and a clearance around the knob. Between them is air.

A joint is a map of space as well: the socket's link stays, the knob's turns, and only the air between shears.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold
from scipy.spatial.transform import Rotation

from mereo.deformation.maps import Rigid, turn
from mereo_objects._solids import Vector, revolved

FAR = 300.0
"""Longer than any object, for prisms that stand for a sector of space."""

CONE_SLOPE = 0.15
"""By how much the knob's radius falls for each unit of height above or below its middle."""

CONE_HEIGHT = 3.0
"""Beyond this height over its middle the knob is a cylinder."""

MARGIN = 0.03
"""The map is rigid up to this far beyond the surfaces of both links (for openings, times the radius, in radians)."""


@dataclass(frozen=True)
class Knuckle:
    """Joint about a vertical axis.

    Attributes:
        pivot: middle of the knob.
        heading_rad: direction in the xy plane from the socket's link to the knob's.
        radius: of the knob at its middle.
        sector_rad: half-angle of the knob's link about ``heading_rad``.
        opening_rad: by how much the opening on each side is wider than that.
        clearance: between knob and socket.
    """

    pivot: Vector
    heading_rad: float
    radius: float
    sector_rad: float
    opening_rad: float
    clearance: float = 0.18

    def knob_side(self) -> Manifold:
        """Part of space that the knob's link may fill."""
        return self._sector(self.sector_rad) + self._knob(0.0)

    def knob_room(self) -> Manifold:
        """Room that has to be free of the socket's link: the knob's side, the opening and the clearance."""
        return self._sector(self.sector_rad + self.opening_rad) + self._knob(self.clearance)

    def _sector(self, half_angle_rad: float) -> Manifold:
        corners = [(0.0, 0.0), *(_polar(self.heading_rad + sign * half_angle_rad) for sign in (-1, 1))]
        prism = Manifold.extrude(CrossSection([np.array(corners)]), FAR)
        return prism.translate((self.pivot[0], self.pivot[1], -FAR / 2))

    def _knob(self, more: float) -> Manifold:
        middle, end = self.radius + more, self.radius + more - CONE_SLOPE * CONE_HEIGHT
        end = max(end, 0.3 * self.radius + more)
        height = (middle - end) / CONE_SLOPE
        profile = [(0.0, -FAR), (end, -FAR), (end, -height), (middle, 0.0), (end, height), (end, FAR), (0.0, FAR)]
        return revolved(np.array(profile), 14).translate(self.pivot)

    def share(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Share of the knob's turn: 1 in its link, 0 in the socket's, and between them linear across the air."""
        x, y, z = (points - np.array(self.pivot)).T
        angle = np.arctan2(y, x) - self.heading_rad
        angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
        opening = np.clip(0.5 + (self.sector_rad + self.opening_rad / 2 - angle) / (0.9 * self.opening_rad), 0.0, 1.0)
        least = max(self.radius - CONE_SLOPE * CONE_HEIGHT, 0.3 * self.radius)
        knob = np.maximum(self.radius - CONE_SLOPE * np.abs(z), least)
        outside = np.clip((np.hypot(x, y) - knob - MARGIN) / (self.clearance - 3 * MARGIN), 0.0, 1.0)
        shares: Float[np.ndarray, " n"] = 1.0 - outside * (1.0 - opening)
        return shares


def _polar(angle_rad: float) -> tuple[float, float]:
    return (FAR * float(np.cos(angle_rad)), FAR * float(np.sin(angle_rad)))


@dataclass(frozen=True, eq=False)
class Hinged:
    """Chain of links, from the one that stays to the last: every knuckle turns what lies on its knob's side.

    Each link moves rigidly. Rotation k is about the pivot of knuckle k at rest, as axis times radians. Where it is
    about the vertical, the Jacobian is 1 plus the angle times the share's slope around the pivot, so that it is
    positive for angles below 0.9 ``opening_rad``; a small tilt of the axis (play in the clearance) adds little.
    """

    knuckles: tuple[Knuckle, ...]
    rotation_vectors: Float[np.ndarray, "k 3"]

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Images of points in a link, or in the air between two."""
        shares = [knuckle.share(points) for knuckle in self.knuckles]
        chain = list(zip(self.knuckles, shares, self.rotation_vectors, strict=True))
        for knuckle, share, vector in reversed(chain):
            angle_rad = max(float(np.linalg.norm(vector)), 1e-12)
            points = turn(points, np.array(knuckle.pivot), vector / angle_rad, angle_rad * share)
        return points


def follow(
    before: Float[np.ndarray, "4 4"], knuckle: Knuckle, rotation_vector: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Motion of a knob's link from rest, given that of its socket's."""
    rotation = Rotation.from_rotvec(rotation_vector).as_matrix()
    pivot = np.array(knuckle.pivot)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, pivot - rotation @ pivot
    return before @ motion


def rigid_map(motion: Float[np.ndarray, "4 4"]) -> Rigid:
    """Deformation of a homogeneous rigid transform."""
    return Rigid(Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3], np.zeros(3))
