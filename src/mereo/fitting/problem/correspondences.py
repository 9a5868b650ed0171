"""Predict correspondences between what a camera sees and the rest pose with a trained network.

Every point of the object lies on a line of sight through an observed point, at it or behind it. So the network is
evaluated at the observed points and along the lines of sight behind them: where it finds a segment, it predicts the
rest position of that point. It is right on what is seen and vague on what is hidden.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mereo.deformation.moving_least_squares import spread
from mereo.models.trained import EncodedCloud, Trained
from mereo.scenes.statistical_model import StatisticalModel

OBSERVED, SIGHT_LINES = 400, 256
"""Observed points at which the network is evaluated, and lines of sight behind them."""

DEPTHS = np.concatenate([np.arange(0.04, 0.6, 0.08), np.arange(0.6, 2.4, 0.15)])
"""Depths behind the observed point, in half longest sides of the visible part."""

CLIPPED = 0.5
"""Largest distance of a point that counts in ``Correspondences.displaced``."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Positions of points of the object in the camera frame and at rest.

    Attributes:
        points: in the camera frame, input unit.
        rest: at rest, in scene units.
        labels: of their segments, 1 or more.
        confidence: probability of that segment, for observed points among the segments alone.
        observed: whether the point is an observed one; otherwise it lies inside the object.
    """

    points: Float[np.ndarray, "n 3"]
    rest: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    confidence: Float[np.ndarray, " n"]
    observed: Bool[np.ndarray, " n"]

    def rows(self, chosen: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Correspondences":
        """Some of them."""
        parts = (self.points, self.rest, self.labels, self.confidence, self.observed)
        return Correspondences(*(part[chosen] for part in parts))

    def scaled(self, factor: float) -> "Correspondences":
        """Correspondences with the camera frame in another unit."""
        return replace(self, points=self.points * factor)

    def displaced(self, model: StatisticalModel, material: Float[np.ndarray, "m 3"]) -> float | None:
        """How far the places of the object are from where a model's state has them, as a share of half its length.

        Root mean square, each ``CLIPPED`` at most; None without correspondences, as where a frame is tracked. Points
        and posed ``material`` are in scene units.
        """
        if len(self.points) == 0:
            return None
        apart = np.linalg.norm(model.weights(self.rest, self.labels)(material) - self.points, axis=1) / model.half
        return float(np.sqrt((np.minimum(apart, CLIPPED) ** 2).mean()))

    def evenly(self, each: int = 125) -> "Correspondences":
        """Even subset: at most ``each`` observed and as many inside, evenly spread in space."""
        chosen = [np.empty(0, dtype=np.int64)]
        for rows in (np.flatnonzero(self.observed), np.flatnonzero(~self.observed)):
            if len(rows):
                chosen.append(rows[spread(self.points[rows], each)])
        return self.rows(np.concatenate(chosen))


def nothing() -> Correspondences:
    """No correspondences, of a frame without a network."""
    none = np.empty((0, 3))
    return Correspondences(none, none, np.empty(0, np.uint8), np.empty(0), np.empty(0, dtype=bool))


def find_correspondences(
    model: Trained, code: EncodedCloud, center: Float[np.ndarray, "3"], half: float
) -> Correspondences | None:
    """Predict correspondences at observed points of an encoded cloud, and along the lines of sight behind them.

    Centre and half the longest side are those of the rest frame, scene units. Returns None from a network without rest
    coordinates.
    """
    seen = code.cloud[:OBSERVED]
    lines = seen[:SIGHT_LINES]
    behind = DEPTHS / code.normalizer.scale / np.linalg.norm(lines, axis=1)[:, None]
    inner = (lines[:, None] * (1.0 + behind[..., None])).reshape(-1, 3)
    predicted = model.correspond(code, np.concatenate([seen, inner]))
    if predicted is None:
        return None
    probability, rest = predicted
    probability[: len(seen), 0] = 0.0  # an observed point is on the object, whatever the network thinks
    probability[: len(seen)] /= np.maximum(probability[: len(seen)].sum(axis=1, keepdims=True), 1e-12)
    labels = probability.argmax(axis=1).astype(np.uint8)
    observed = np.arange(len(labels)) < len(seen)
    confidence = probability.max(axis=1).astype(np.float64)
    everything = Correspondences(np.concatenate([seen, inner]), rest * half + center, labels, confidence, observed)
    return everything.rows(labels > 0)


class NoFit(ValueError):
    """Frame to which no model can be fitted, for a reason that its sender can mend."""


# --- length of a scene unit -------------------------------------------------------------------------------------------

UNIT_TOLERANCE = 0.15
"""Difference of a stated unit from the correspondences' own up to which it is believed; no two units that are mistaken
for each other are nearer than a factor of 2.5."""


def agree(first: float, second: float) -> bool:
    """Whether two units differ by no more than ``UNIT_TOLERANCE``."""
    return abs(float(np.log(first / second))) < float(np.log1p(UNIT_TOLERANCE))


def estimate_unit(correspondences: Correspondences) -> float:
    """Estimate a scene unit's length in the correspondences' unit: distances within a segment hardly change."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(correspondences.labels), size=(2, 4000))
    rest = np.linalg.norm(correspondences.rest[first] - correspondences.rest[second], axis=1)
    seen = np.linalg.norm(correspondences.points[first] - correspondences.points[second], axis=1)
    usable = (correspondences.labels[first] == correspondences.labels[second]) & (rest > np.median(rest[rest > 0]) / 4)
    if not usable.any():
        raise NoFit(
            f"the network finds only {len(correspondences.labels)} points of the object, too few to tell its size: "
            "name the unit with scene_unit, or isolate the object first"
        )
    return float(np.median(seen[usable] / rest[usable]))
