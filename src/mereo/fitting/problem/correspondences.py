"""A trained network's guess of a state: where it has places of the object, in what a camera sees.

    EncodedCloud -find_correspondences-> Correspondences -fit_correspondences-> Posed

Every point of the object lies on a line of sight through an observed point, at it or behind it. So the network is
evaluated at the observed points and along the lines of sight behind them: where it finds a segment, it predicts the
rest position of that point. It is right on what is seen and vague on what is hidden, so that a fit only begins there.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mereo.deformation.moving_least_squares import PointWeights, spread
from mereo.fitting.problem.gauss_newton import DAMPING, Posed, geman_mcclure, in_space
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import ROBUST, PlacesTerm, Prior
from mereo.geometry.transforms import Points, robust_rigid
from mereo.models.trained import EncodedCloud, Trained
from mereo.scenes.statistical_model import StatisticalModel

OBSERVED, SIGHT_LINES = 400, 256
"""Observed points at which the network is evaluated, and lines of sight behind them."""

DEPTHS = np.concatenate([np.arange(0.04, 0.6, 0.08), np.arange(0.6, 2.4, 0.15)])
"""Depths behind the observed point, in half longest sides of the visible part."""

EACH = 125
"""Observed points, and points inside the object, that a state is fitted to, evenly spread."""

WORTH, STEPS, WIDE = 500.0, 8, 2.5
"""How many independent points all of them are worth, steps of the fit, and its first standard deviation in the last."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Positions of points of the object in the camera frame and at rest.

    Attributes:
        points: in the camera frame, input unit.
        rest: at rest, in scene units.
        labels: of their segments, 1 or more.
        confidence: probability of that segment, for observed points among the segments alone.
    """

    points: Points
    rest: Points
    labels: UInt8[np.ndarray, " n"]
    confidence: Float[np.ndarray, " n"]

    def rows(self, chosen: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Correspondences":
        """Some of them."""
        return Correspondences(*(part[chosen] for part in vars(self).values()))


def find_correspondences(network: Trained, code: EncodedCloud, model: StatisticalModel) -> Correspondences | None:
    """Predict correspondences at observed points of an encoded cloud, and along the lines of sight behind them.

    None from a network without rest coordinates.
    """
    seen = code.cloud[:OBSERVED]
    lines = seen[:SIGHT_LINES]
    behind = DEPTHS / code.normalizer.scale / np.linalg.norm(lines, axis=1)[:, None]
    inner = (lines[:, None] * (1.0 + behind[..., None])).reshape(-1, 3)
    places = np.concatenate([seen, inner])
    predicted = network.correspond(code, places)
    if predicted is None:
        return None
    probability, rest = predicted
    probability[: len(seen), 0] = 0.0  # an observed point is on the object, whatever the network thinks
    probability[: len(seen)] /= np.maximum(probability[: len(seen)].sum(axis=1, keepdims=True), 1e-12)
    labels = probability.argmax(axis=1).astype(np.uint8)
    inside = len(seen) + np.flatnonzero(labels[len(seen) :])
    rows = np.concatenate([spread(seen, EACH), inside[spread(places[inside], EACH)] if len(inside) else inside])
    confidence = probability.max(axis=1).astype(np.float64)
    return Correspondences(places, rest * model.half + model.rest_center, labels, confidence).rows(rows)


def fit_correspondences(problem: Problem, matches: Correspondences, unit: float) -> tuple[Problem, Posed]:
    """Fit pose and modes to correspondences alone, from the mean state.

    ``unit`` is the length of a scene unit of the problem in that of the correspondences. Returns the problem with them
    as its ``network``, too.
    """
    model = problem.model
    term = PlacesTerm(matches.points / unit, model.weights(matches.rest, matches.labels), matches.confidence)
    scale = scale_of(matches, unit) if problem.is_scale_open else 1.0
    return replace(problem, network=term), fit_places(problem, term, np.zeros(model.count), float(np.log(scale)))


def fit_places(problem: Problem, term: PlacesTerm, z: Float[np.ndarray, " k"], log_scale: float) -> Posed:
    """Fit pose and modes to places alone, from wide to narrow, beginning with coefficients and a scale."""
    model, sigma = problem.model, problem.first_sigma
    rows, index = np.unique(term.weights.index, return_inverse=True)
    weights = PointWeights(index.reshape(term.weights.index.shape), term.weights.weight)
    points = weights(model.positions(z[None], rows)[0])
    T = robust_rigid(np.exp(log_scale) * points, term.target, term.confidence, sigma)
    posed = Posed(T[:3, :3], T[:3, 3], z, log_scale)
    for std in sigma * WIDE ** np.linspace(1.0, 0.0, STEPS):
        points = posed.place(weights(model.positions(posed.z[None], rows)[0]))
        motion = weights(model.tangent(posed.z, rows))
        offset = points - term.target
        weight = term.confidence / term.confidence.sum() * (WORTH / std**2)
        weight = weight * geman_mcclure(np.linalg.norm(offset, axis=1), ROBUST * std)
        normal = problem.known(posed, Prior.whole(model), 0.0)
        normal = normal.add(in_space(posed, points, motion), offset.ravel(), np.repeat(weight, 3))
        posed = posed.moved(normal.step(DAMPING))
    return posed


def scale_of(matches: Correspondences, unit: float) -> float:
    """Scale of what was seen, in a unit: distances within a segment hardly change; 1 where too few are predicted."""
    first, second = np.random.default_rng(0).integers(len(matches.labels), size=(2, 4000))
    rest = np.linalg.norm(matches.rest[first] - matches.rest[second], axis=1)
    seen = np.linalg.norm(matches.points[first] - matches.points[second], axis=1)
    usable = (matches.labels[first] == matches.labels[second]) & (rest > np.median(rest) / 4)
    return float(np.median(seen[usable] / rest[usable])) / unit if usable.any() else 1.0
