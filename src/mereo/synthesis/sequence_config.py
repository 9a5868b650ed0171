"""Settings of sequences; light, so that the command line may import them."""

from dataclasses import dataclass

from mereo.io.bounds import ImageSize, NotNegative, Positive, check_bounds
from mereo.synthesis.config import Occluder


@dataclass(frozen=True)
class SequenceConfig:
    """Settings of a sequence.

    Attributes:
        seconds: how long it is.
        rate: frames per second.
        change: seconds in which the object comes from one state to about an independent one.
        camera_change: the same of the camera; its way is short.
        occluder: what passes in front of the object, in the middle of the sequence.
        occluded: seconds for which it is in view.
        image_size: the depth image is square, in pixels.
        noise_std: Gaussian noise on the depth, standard deviation in scene units.
    """

    seconds: Positive = 5.0
    rate: Positive = 30.0
    change: Positive = 1.5
    camera_change: Positive = 4.0
    occluder: Occluder = "tool"
    occluded: Positive = 1.0
    image_size: ImageSize = 96
    noise_std: NotNegative = 0.1

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.frames < 2:
            raise ValueError(
                f"{self.seconds:g} s at {self.rate:g} frames a second are {self.frames} frames; a sequence has at "
                "least 2: make it longer"
            )

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.seconds * self.rate)

    @property
    def hidden_s(self) -> tuple[float, float]:
        """First and last time at which the occluder may be in view; the same without one."""
        span = 0.0 if self.occluder == "none" else min(self.occluded, self.seconds)
        return (self.seconds - span) / 2, (self.seconds + span) / 2
