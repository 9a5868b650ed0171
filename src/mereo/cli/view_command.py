"""The command ``mereo view``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from mereo.cli.options import InputOrNone, MeshUnits
from mereo.io.bounds import Cells, Port
from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig


@dataclass(frozen=True)
class ViewCommand:
    """Look at a frame and its reconstruction in a browser, or move a scene by hand (--scene): needs the extra `view`.

    Attributes:
        input: a point cloud or depth image, as for `mereo reconstruct`, or a result of it (the folder, or its
            state.json; the YAML scene file that it was made with is found again); a GLB file; a folder of `mereo scene
            record`, which is played; without it (and --scene) a shipped frame.
        object: what is looked for in the frame, as for `mereo reconstruct`: its meshes or its scene.
        weights: a shipped name or a file; by default those of the state, or those shipped for the frame or the scene.
        units: of the object's meshes; guessed where not given.
        scene: open the laboratory of this scene: its name, or a scene file of your own (.yaml, .py).
        state: a result with a registered model: shown on the frame, or where the laboratory's sliders start.
        port: where the page is; 0 takes any that is free.
        host: address of this machine that the page is at. Only this machine reaches the default. Another one needs the
            token of the address that is printed, and others on the network can read along: ssh -L is safer.
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
    state: Path | None = None
    port: Port = 8080
    host: str = "127.0.0.1"
    resolution: Cells = 128
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)

    def run(self) -> None:
        """Open the page of a frame or of a scene, and keep it until Ctrl-C."""
        if self.object:
            self._view_object()
            return
        from mereo.visualization.viewer.serve import view

        view(
            self.input,
            self.weights,
            scene=self.scene,
            state=self.state,
            port=self.port,
            host=self.host,
            resolution=self.resolution,
            reading=self.reading,
            isolation=self.isolation,
            inference=self.inference,
            block=True,
        )

    def _view_object(self) -> None:
        """Find an object in a frame, and keep the page of the answer open."""
        if self.input is None:
            raise ValueError("no frame is given; --object is looked for in one: mereo view FRAME --object PART.stl")
        from mereo.fitting.registration.state import is_state

        if self.state is not None:
            raise ValueError(f"--state is {self.state}, which has its own object: leave out --object")
        if is_state(self.input):
            raise ValueError(f"{self.input} is a result, which shows itself: leave out --object")
        from mereo.api.reconstruct import reconstruct
        from mereo.cli.options import loaded_object
        from mereo.evaluation.sample_views import shipped_frame, shipped_frames
        from mereo.io.progress import shown_stages
        from mereo.io.sensor_frame import read_frame
        from mereo.visualization.viewer.display import import_viser
        from mereo.visualization.viewer.result_page import open_answer

        import_viser()
        with shown_stages():
            is_shipped = str(self.input) in shipped_frames() and not self.input.exists()
            frame = shipped_frame(str(self.input)) if is_shipped else read_frame(self.input, self.reading)
            found = loaded_object(self.object, self.weights, self.scene, self.units, self.inference)
            result = reconstruct(frame, found, resolution=self.resolution, isolation=self.isolation)
            page = open_answer(result, port=self.port, host=self.host)
        page.stay(True)
