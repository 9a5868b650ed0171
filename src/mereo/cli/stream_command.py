"""``mereo stream``: see ``commands`` for how commands are written."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig


@dataclass(frozen=True)
class StreamCommand:
    """Reconstruct frames as they come: the latest one wins, a bad one is reported and passed over.

    Each answer is one line of JSON on standard output, in the input's frame and units; rate and latency come at the
    end, on standard error.

    Attributes:
        source: a folder of depth images or point clouds, a ROS recording, or - for file names on standard input.
        weights: a shipped name or a file.
        resolution: grid cells along the longest side: fewer are faster.
        rate: frames per second at which a folder was recorded.
        every_frame: answer all frames, however long it takes, instead of the latest.
        surfaces: folder for the surfaces of each answered frame, one GLB file each.
        reading: how a frame is read.
        isolation: what is left out of it.
        inference: where and how exactly the network computes.
    """

    source: Positional[str]
    weights: str
    resolution: int = 48
    rate: float = 30.0
    every_frame: bool = False
    surfaces: Path | None = None
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)

    def run(self) -> None:
        from mereo.cli.stream import stream_reconstructions

        stream_reconstructions(
            self.source,
            self.weights,
            resolution=self.resolution,
            rate_hz=self.rate,
            every_frame=self.every_frame,
            surfaces=self.surfaces,
            reading=self.reading,
            isolation=self.isolation,
            inference=self.inference,
        )
