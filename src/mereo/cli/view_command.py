"""The command ``mereo view``."""

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import arg

from mereo.cli.options import InputOrNone, MeshUnits
from mereo.io.bounds import Cells, Port
from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig


@dataclass(frozen=True)
class ViewCommand:
    """Look at a frame and its reconstruction in a browser, or try an object (--scene): needs the extra `view`.

    Only this machine reaches the page; from another one use a tunnel: ssh -L 8080:127.0.0.1:8080 HOST.

    Attributes:
        input: a point cloud or depth image, as for `mereo reconstruct`, or the folder of a result of it; a GLB file;
            without it (and --scene, --object) a shipped frame.
        object: what is looked for in the frame, as for `mereo reconstruct`: its meshes or its scene. Without a frame
            the laboratory of this object is opened.
        weights: a shipped name or a file; by default those of the shipped frame, or none.
        units: of the object's meshes; guessed where not given.
        scene: open the laboratory of this scene: its name, or a scene file of your own (.yaml, .py). States of its are
            shown to a simulated camera, and what is found in its image beside the truth.
        port: where the page is; 0 takes any that is free.
        resolution: grid cells along the longest side.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
    """

    input: InputOrNone = None
    object: tuple[str, ...] = ()
    weights: str | None = None
    units: MeshUnits = None
    scene: str | None = None
    port: Port = 8080
    resolution: Cells = 128
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)

    def run(self) -> None:
        """Open a page, and keep it until Ctrl-C."""
        from mereo.api.view import view
        from mereo.scenes.registry import load_scene
        from mereo.scenes.scene import SCENES

        one = self.object[0] if len(self.object) == 1 else None
        # a scene's name is that scene, never the weights of the same name
        object = list(self.object) or None if one is None else load_scene(one) if one in SCENES else one
        view(
            self.input,
            self.weights,
            object=object,
            scene=self.scene,
            units=self.units,
            port=self.port,
            resolution=self.resolution,
            reading=self.reading,
            isolation=self.isolation,
            inference=self.inference,
            block=True,
        )
