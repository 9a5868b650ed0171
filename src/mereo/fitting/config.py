"""Settings and constants of the fit; light, so that the command line may import them."""

from dataclasses import dataclass, replace
from typing import Literal

AnswerMethod = Literal["auto", "network", "search", "modes"]
"""Source of the answer to a frame: the registered model, found from a network's guess where there is one; the network
alone; the registered model without a network; or by its modes alone, without the draws of its scene."""

LocatedBy = Literal["search", "network", "pose"]
"""What located the object in a frame: a search over poses and states, a trained network, whose answer then it is, or a
pose that was given."""

Tracking = Literal["found", "followed", "lost"]
"""State of a tracked object in a frame: found by itself; followed from the last frame; or lost, so that its pose is
not known."""


@dataclass(frozen=True)
class FitConfig:
    """Constants of the fit; lengths are scene units if nothing else is stated.

    Attributes:
        start_sigma: the cloud's standard deviation at first, as a share of half the rest box's longest side.
        cloud_sigma: last standard deviation of the cloud, where its noise is not larger.
        cloud_weight: how many independent points the cloud is worth.
        samples: points of the surface that stand for it in most steps.
        silhouette_vertices: how many of them are compared with what the frame rules out.
        silhouette_weight: how many independent points one of them is worth, of ``SILHOUETTE_VERTICES``.
        exact_steps: last steps, which use the faces themselves.
        by_normals: whether the normals of a camera's points are compared with the surface's; of a surface that no
            single camera saw they are in any case.
        normal_length: distance, as a share of the same half, that a difference of unit normals by 1 is worth there in
            the search for the sample of each observed point.
        accepted, tolerance: a fit is believed where this share of the observed points lies as near its facing surface.
    """

    start_sigma: float = 0.06
    cloud_sigma: float = 0.2
    cloud_weight: float = 3000.0
    samples: int = 3000
    silhouette_vertices: int = 500
    silhouette_weight: float = 0.2
    exact_steps: int = 3
    by_normals: bool = False
    normal_length: float = 0.1
    accepted: float = 0.95
    tolerance: float = 0.45


@dataclass(frozen=True)
class DrawsConfig:
    """Constants of the fit of draws.

    Attributes:
        starts: random states, most like a shape, from which fits start.
        approaching: how many of these approach the shape at most.
        cloud_weight: how many independent points the cloud is worth, also where draws and modes are compared.
        last_rounds: sets of differences in the fit to the frame.
        steps: at most with one set of differences.
    """

    starts: int = 40
    approaching: int = 10
    cloud_weight: float = 1500.0
    last_rounds: int = 2
    steps: int = 6


ELASTIC = FitConfig(cloud_sigma=0.12, cloud_weight=250.0, samples=10_000, by_normals=True)
"""Constants for objects whose model is that of an elastic solid, which real states are near but never in.

What they are off by is shared by many points, so the cloud is worth fewer; experiments, entry 68."""


StreamMethod = Literal["auto", "network", "search"]
"""Source of the answers to a sequence, as ``AnswerMethod``; draws take longer than the time between two frames."""


@dataclass(frozen=True)
class TrackConfig:
    """Constants of following an object.

    Attributes:
        speed: standard deviation of a material point's way from there, scene units per second.
        gain: how many times its present speed is added to that: what is still stays still, what moves may turn.
        dead: speed that noise alone makes a still object seem to have, which is not counted, neither here nor in where
            it is expected; scene units per second.
        first_speed: the same while nothing is known of its motion, right after a frame's own fit.
        least: standard deviation in however short a time, scene units.
        smoothing: weight of a frame's motion against what was known before.
        motion_weight: how many independent points the expectation is worth, in each direction.
        points: denser clouds are averaged to so many points.
        observed_samples: observed points, evenly spread, that are compared with the surface.
        first_sigma: the cloud's first standard deviation, as a share of half the rest box's longest side; it falls by
            ``cooling`` in each step to that of the frame's noise.
        steps, exact_steps: steps on samples of the surface, and last ones on its faces.
        gate: distance from the expected surface beyond which a point is left out, as a share of the same half.
        least_area: share of the greatest area that was ever seen of the object, below which it is lost.
        most_ruled_out: share of the surface that the frame may rule out before the object is lost.
        scale_std: standard deviation of the scale's logarithm from frame to frame, where the unit is not known.
        longest_s: a longer time without a frame ends the track.
    """

    speed: float = 1.0
    gain: float = 10.0
    dead: float = 0.5
    first_speed: float = 20.0
    least: float = 0.02
    smoothing: float = 0.2
    motion_weight: float = 300.0
    points: int = 2000
    observed_samples: int = 500
    first_sigma: float = 0.04
    cooling: float = 0.5
    steps: int = 3
    exact_steps: int = 1
    gate: float = 0.25
    least_area: float = 0.15
    most_ruled_out: float = 0.3
    scale_std: float = 0.002
    longest_s: float = 1.0

    @property
    def patient(self) -> "TrackConfig":
        """The same with more steps, the first of them wider: for what has moved far since the last frame."""
        return replace(self, steps=4 * self.steps, first_sigma=2 * self.first_sigma, cooling=0.75)
