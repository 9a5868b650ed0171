"""Lines of sight of a frame that did not meet the object: what they say of the space beside it.

Every line of sight is of one of three kinds (docs/registration.md): it met the *object*; it went *past* it,
to something farther away, so that the space before that is empty; or it is *unknown*: something nearer hides what is
behind, nothing was measured, or it lies outside the picture. The camera is at the origin.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

SightKind = Literal["past", "unknown"]
"""Kind of a line of sight that did not meet the object."""


@dataclass(frozen=True, eq=False)
class SightLines:
    """Lines of sight beside the object, in the frame, axes and unit of its points.

    Attributes:
        past: points that were measured behind the object; the space between the camera and each is empty.
        unknown: points anywhere on lines of sight along which nothing is known.
        other_lines: kind of all lines of sight that none of these points, and none of the object's, is near; None where
            the frame does not say, as a bare cloud does not, and then a fit has to decide.
    """

    past: Float[np.ndarray, "p 3"]
    unknown: Float[np.ndarray, "u 3"]
    other_lines: SightKind | None = None

    @classmethod
    def of_cloud(cls, other_lines: SightKind | None = None) -> "SightLines":
        """Lines of sight beside a bare cloud, all of one kind, or of an undecided one."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), other_lines)

    def transformed(self, T_new_old: Float[np.ndarray, "4 4"]) -> "SightLines":
        """Lines of sight in another frame, whose origin is the camera as well."""
        past, unknown = (points @ T_new_old[:3, :3].T + T_new_old[:3, 3] for points in (self.past, self.unknown))
        return SightLines(past, unknown, self.other_lines)

    def scaled(self, factor: float) -> "SightLines":
        """Lines of sight in another unit."""
        return SightLines(self.past * factor, self.unknown * factor, self.other_lines)
