"""Constants of following an object from frame to frame; light, so that the command line may import them."""

from dataclasses import dataclass, replace
from typing import Literal

StreamMethod = Literal["auto", "network", "search", "modes"]
"""Source of the answers to a sequence, as ``AnswerMethod``; draws take longer than the time between two frames."""

MotionModel = Literal["pose", "velocity"]
"""What is expected of the next frame: the last state, or the last state moved on as it has moved."""


@dataclass(frozen=True)
class TrackConfig:
    """Constants of following an object.

    Attributes:
        motion: what is expected of the next frame.
        speed: standard deviation of a material point's way from there, scene units per second.
        gain: how many times its present speed is added to that: what is still stays still, what moves may turn.
        dead: speed that noise alone makes a still object seem to have, which is not counted, neither here nor in where
            it is expected; scene units per second.
        first_speed: the same while nothing is known of its motion, right after the network was asked.
        least: standard deviation in however short a time, scene units.
        smoothing: share of what a frame says of the motion that is believed, the rest is what was known before.
        motion_weight: how many independent points the expectation is worth, in each direction.
        points: denser clouds are averaged to so many points.
        observed_samples: observed points, evenly spread, that are compared with the surface.
        first_sigma: the cloud's first standard deviation, as a share of half the rest box's longest side; it falls by
            ``cooling`` in each step to that of the frame's noise.
        steps, exact_steps: steps that ask samples of the surface, and last ones that ask its faces.
        gate: distance from the expected surface beyond which a point is left out, as a share of the same half.
        drop: share of the points by which a frame may be explained less than the best since the network was asked.
        margin: share of the points that a frame's own fit must explain more than a lost track to take its place.
        least_area: share of the greatest area that was ever seen of the object, below which it is lost.
        most_ruled_out: share of the surface that the frame may rule out before the object is lost.
        scale_std: standard deviation of the scale's logarithm from frame to frame, where the unit is not known.
        longest_s: a longer time without a frame ends the track.
    """

    motion: MotionModel = "velocity"
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
    drop: float = 0.05
    margin: float = 0.02
    least_area: float = 0.15
    most_ruled_out: float = 0.3
    scale_std: float = 0.002
    longest_s: float = 1.0

    @property
    def patient(self) -> "TrackConfig":
        """The same with more steps, the first of them wider: for what has moved far since the last frame."""
        return replace(self, steps=4 * self.steps, first_sigma=2 * self.first_sigma, cooling=0.75)
