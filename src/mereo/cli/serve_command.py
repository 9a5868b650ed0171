"""The command ``mereo serve``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from mereo.fitting.config import AnswerMethod
from mereo.io.bounds import Cells, Port, Workers
from mereo.models.config import InferenceConfig
from mereo_serving.config import ServeConfig

NEEDED = ("fastapi", "uvicorn", "prometheus_client", "python_multipart")
"""Modules of the extra."""


@dataclass(frozen=True)
class ServeCommand:
    """Answer frames of many clients over HTTP: a depth image or cloud in, JSON or GLB out: needs the extra `serve`.

    POST a frame to /v1/NAME/reconstruct; /docs says how, /metrics has numbers for Prometheus. TERM and Ctrl-C answer
    what is begun and refuse the rest.

    Attributes:
        object: meshes, joined by commas, or a scene, once for each object that has no weights; NAME=FILE,FILE says what
            clients call it.
        weights: a shipped name or a file, once for each object that has them; NAME=FILE says what clients call it.
        scene: NAME=FILE of the scene whose draws are fitted, where it is not the built-in one of the weights; once for
            each.
        method: register the object's own deformation model to the frames: auto takes the registered model where it
            explains the frame, if the weights carry one; network leaves the network's answer, search the network out;
            modes and full take the model in any case, full by fitting the draws of the scene as well.
        port: where it listens; 0 takes any that is free.
        host: address of this machine. Only this machine reaches the default. Another one needs the token of the address
            that is printed, and others on the network can read along: a proxy that encrypts is safer.
        resolution: grid cells along the longest side, where a request does not say.
        limits: so that no client, and no crowd of them, takes more than the machine has.
        inference: where and how exactly the networks compute.
        workers: processes that answer, each with all weights and one thread; 0 means one per core.
    """

    object: UseAppendAction[tuple[str, ...]] = ()
    weights: UseAppendAction[tuple[str, ...]] = ()
    scene: UseAppendAction[tuple[str, ...]] = ()
    method: AnswerMethod = "auto"
    port: Port = 8000
    host: str = "127.0.0.1"
    resolution: Cells = 128
    limits: Annotated[ServeConfig, arg(name="")] = field(default_factory=ServeConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)
    workers: Workers = 0

    def run(self) -> None:
        """Serve until a signal asks for the end."""
        if missing := [name for name in NEEDED if find_spec(name) is None]:
            raise ImportError(f"{missing[0]} is not installed; `mereo serve` needs it: run pip install 'mereo[serve]'")
        from mereo.io.cores import cores
        from mereo_serving.server import serve

        serve(
            self.weights,
            objects=self.object,
            scenes=self.scene,
            method=self.method,
            resolution=self.resolution,
            host=self.host,
            port=self.port,
            workers=self.workers or cores(),
            config=self.limits,
            inference=self.inference,
        )
