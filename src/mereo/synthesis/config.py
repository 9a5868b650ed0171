"""Settings of examples and of sequences: simulated depth cameras, query points, the depth image and its cloud.

Light, so that the command line may import them.
"""

from dataclasses import asdict, dataclass, replace
from typing import Literal

from tyro.conf import OmitArgPrefixes

from mereo.geometry.conventions import Range, WorkspaceName
from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import (
    ImageSize,
    Multiple,
    NotNegative,
    Points,
    Positive,
    Probability,
    Queries,
    Times,
    check_bounds,
)

SensorModel = Literal["structured-light", "time-of-flight"]


@dataclass(frozen=True)
class SensorConfig:
    """Strengths of real depth cameras' errors besides the paper's noise, each off at 0 (docs/design/0006-sensors.md).

    A strength of 1 is as published. The formulas are in metres, scenes in their own units.

    Attributes:
        metres_per_unit: size of a scene unit; 0.005 makes objects 10 cm thick, seen from 0.5 to 1 m, where depth
            cameras of arm's reach work.
        model: whose formulas the axial and lateral noise follow.
        axial: strength of the noise along the ray, which grows with distance and slant.
        lateral: strength of the noise across the ray: where a pixel looks.
        quantization: strength of the depth steps of structured light, which grow with the distance squared.
        flying: probability that a pixel at a depth edge lies between both sides; the object's outline is such an edge
            where there is a background.
        dropout: probability that a pixel on a surface seen edge-on is missing; below 60 degrees of slant none is.
        holes: mean number of missing blobs on the object (mirroring or absorbing spots).
        hole_radius_m: their mean radius in metres.
        tool: probability of a thin tool in front of the object.
        hand: probability of a hand with its forearm in front of the object.
        background: probability of a plane behind the object, which a wrong mask lets in.
        mask_offset_px: how far the mask's edge is off, outward or inward, standard deviation in pixels of the image.
        mask_shift_px: how far the whole mask is off, standard deviation along each axis in pixels of the image.
    """

    metres_per_unit: Positive = 0.005
    model: SensorModel = "structured-light"
    axial: NotNegative = 0.0
    lateral: NotNegative = 0.0
    quantization: NotNegative = 0.0
    flying: Probability = 0.0
    dropout: Probability = 0.0
    holes: NotNegative = 0.0
    hole_radius_m: Positive = 0.01
    tool: Probability = 0.0
    hand: Probability = 0.0
    background: Probability = 0.0
    mask_offset_px: NotNegative = 0.0
    mask_shift_px: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_bounds(self, "sensor.")

    @property
    def on(self) -> bool:
        """Whether anything differs from the paper's sensor."""
        return any(getattr(self, name) != 0 for name in SENSOR_TERMS)


SENSOR_TERMS = (
    *("axial", "lateral", "quantization", "flying", "dropout", "holes", "tool", "hand", "background"),
    *("mask_offset_px", "mask_shift_px"),
)
"""Settings without which a sensor is off; each term draws from a random stream of its own."""

Sensor = Literal["paper", "structured-light", "time-of-flight"]

# noisy, with a segmentation that is about half a pixel off
_REAL = SensorConfig(axial=1.0, lateral=1.0, background=1.0, mask_offset_px=0.5, mask_shift_px=0.3)

SENSORS: dict[Sensor, SensorConfig] = {
    # Gaussian noise alone, GenerateConfig.noise_std
    "paper": SensorConfig(),
    # the first Kinect and its kin
    "structured-light": replace(_REAL, quantization=1.0, dropout=0.8, holes=1.0),
    # the second Kinect and its kin: no depth steps, but flying pixels
    "time-of-flight": replace(_REAL, model="time-of-flight", flying=0.5, dropout=0.5, holes=0.5),
}

Occluder = Literal["none", "tool", "hand"]
"""What may stand in front of the object (``synthesis.clutter``)."""

ObservationName = Literal["paper", "structured-light", "time-of-flight", "tool", "hand", "mask"]

OBSERVATIONS: dict[ObservationName, SensorConfig] = {
    "paper": SENSORS["paper"],
    "structured-light": SENSORS["structured-light"],
    "time-of-flight": SENSORS["time-of-flight"],
    # what stands in front hides a part, and a mask that is wrong at its edge lets it in
    "tool": replace(SENSORS["structured-light"], tool=1.0),
    "hand": replace(SENSORS["time-of-flight"], hand=1.0),
    # a segmentation that is wrong by more than a pixel, so that whole strips of the background are strays
    "mask": replace(SENSORS["structured-light"], mask_offset_px=1.5, mask_shift_px=1.0),
}
"""Sensors of further observations by name; each draws from the stream of its place, so new ones go to the end."""

TEMPLATE, STATISTICAL_MODEL = "template.safetensors", "statistical_model.safetensors"
"""Files of a dataset with the segments at rest (``scenes.rest_pose``), and with the object's statistical model."""


Sampler = Literal["volume-uniform", "label-uniform", "sort-sample", "nested-sort-sample"]


@dataclass(frozen=True)
class SamplingConfig:
    """Settings of where training queries are drawn (paper, section 3.2, "Sampling Method for Query Points").

    Attributes:
        sampler: one of the paper's three samplers, or the authors' later NestedSortSample.
        per_segment: points kept for each segment, half inside and half outside except for volume-uniform.
        oversample: SortSample's n / k; 1 keeps about all inside points, 2 points closer to the surface.
        box_margin: each segment's box is extended by this fraction of its size, half on each side.
        uniform_fraction: further points drawn uniformly in the joint box, as a fraction of all per-segment points;
            3 / 17 of these is the paper's 15 % of the total.
    """

    sampler: Sampler = "sort-sample"
    per_segment: Queries = 256
    oversample: Times = 1
    box_margin: Positive = 0.5
    uniform_fraction: Multiple = 3 / 17

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.per_segment % 2:
            raise ValueError(
                f"per_segment is {self.per_segment}; half the points go inside and half outside: pass an even number"
            )

    def total(self, segments: int) -> int:
        """Number of queries of one example."""
        return self.per_segment * segments + round(self.uniform_fraction * self.per_segment * segments)


@dataclass(frozen=True)
class GenerateConfig:
    """Settings of how one example is made (paper, appendix B).

    Attributes:
        image_size: the depth image is square, in pixels.
        noise_std: Gaussian noise on the depth, standard deviation in scene units.
        points: the observed cloud is kept in farthest-point order, at most this many points.
        sampling: where queries are drawn.
        sensor: what else is wrong with the depth image; nothing in the paper.
        observations: further clouds of every example's state and camera, each by another sensor, of which training
            sees a random one; all are those that differ from the example's own sensor.
        workspace: where the camera may be: own is what the scene states; cone is on one side of the object (the paper's
            140 degrees about its upward direction, where the scene has no cone of its own); sphere is all around it, at
            any roll.
    """

    image_size: ImageSize = 96
    noise_std: NotNegative = 0.1
    points: Points = 1024
    # the marker keeps --sampler short on the command line, where --sensor.axial keeps its prefix
    sampling: OmitArgPrefixes[SamplingConfig] = SamplingConfig()
    sensor: SensorConfig = SensorConfig()
    observations: tuple[ObservationName | Literal["all"], ...] = ()
    workspace: WorkspaceName = "own"

    def __post_init__(self) -> None:
        check_bounds(self)
        unknown = [name for name in self.observations if name not in (*OBSERVATIONS, "all")]
        if unknown:
            raise ValueError(
                f"observations has {unknown[0]!r}; known are {', '.join(OBSERVATIONS)} and all: name some of these"
            )

    @property
    def further(self) -> dict[ObservationName, SensorConfig]:
        """Sensors of the further observations by name, in the order in which they are stored."""
        if "all" in self.observations:
            return {name: sensor for name, sensor in OBSERVATIONS.items() if sensor != self.sensor}
        return {name: OBSERVATIONS[name] for name in self.observations if name != "all"}

    def stated(self) -> JsonObject:
        """Settings as a manifest has them: further observations with their sensors, and no word of these without any.

        Nor of the workspace where it is the scene's own.
        """
        stated = asdict(self)
        names = stated.pop("observations") and list(self.further)
        place = stated.pop("workspace")
        sensors = {name: asdict(sensor) for name, sensor in self.further.items()}
        stated |= {"observations": names, "sensors": sensors} if names else {}
        return stated | ({} if place == "own" else {"workspace": place})


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
    def hidden_s(self) -> Range:
        """First and last time at which the occluder may be in view; the same without one."""
        span = 0.0 if self.occluder == "none" else min(self.occluded, self.seconds)
        return (self.seconds - span) / 2, (self.seconds + span) / 2
