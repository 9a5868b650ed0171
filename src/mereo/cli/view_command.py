"""The command ``mereo view``. See ``commands``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig


@dataclass(frozen=True)
class ViewCommand:
    """Look at a frame and its reconstruction in a browser, or move a scene by hand (--scene): needs the extra `view`.

    Attributes:
        input: a point cloud or depth image, as for `mereo reconstruct`; without it (and --scene) a shipped frame.
        weights: a shipped name or a file; by default those that are shipped for the frame or the scene.
        scene: open the laboratory of this scene: its name, or a scene file of your own (.yaml, .py).
        port: where the page is, on this machine only (127.0.0.1); 0 takes any that is free.
        resolution: grid cells along the longest side.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
    """

    input: Positional[Path | None] = None
    weights: str | None = None
    scene: str | None = None
    port: int = 8080
    resolution: int = 128
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)

    def run(self) -> None:
        from mereo.visualization.viewer.serve import view_frame, view_scene

        if self.scene is not None:
            if self.input is not None:
                raise ValueError(f"both {self.input} and --scene {self.scene} are given; one can be shown: drop one")
            view_scene(self.scene, self.weights, port=self.port, inference=self.inference)
            return
        view_frame(
            self.input,
            self.weights,
            port=self.port,
            resolution=self.resolution,
            reading=self.reading,
            isolation=self.isolation,
            inference=self.inference,
        )
