"""What the server's processes say to each other: frames to be answered, replies, and facts of the weights.

    server -FrameRequest-> process that answers -Reply-> server

Everything here is plain data that can be pickled, and nothing in it comes from a client but checked values.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mereo.fitting.config import AnswerMethod
from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig, Precision
from mereo.reconstruction.config import IsolationConfig

Media = Literal["application/json", "model/gltf-binary"]
"""Media types of an answer: figures as in summary.json, or surfaces as in segments.glb."""

JSON: Media = "application/json"
GLB: Media = "model/gltf-binary"


@dataclass(frozen=True)
class Served:
    """Object that is served.

    Attributes:
        name: by which clients know it.
        weights: a shipped name or a file; None of an object without.
        scene: whose draws are fitted, where it is not the built-in one that the weights were trained on.
        object: its meshes or scene, where it has no weights.
    """

    name: str
    weights: str | None = None
    scene: str | None = None
    object: tuple[str, ...] = ()


@dataclass(frozen=True)
class Setup:
    """All that a process needs to begin.

    Attributes:
        served: weights, by their names.
        method: source of the answers.
        inference: where and how exactly the networks compute.
        max_points: most points of a frame.
        max_body: most bytes of a request.
    """

    served: tuple[Served, ...]
    method: AnswerMethod = "auto"
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    max_points: int = 1_000_000
    max_body: int = 64_000_000


@dataclass(frozen=True)
class FrameRequest:
    """Frame to be answered; its files lie in a folder of the server's own, under names of the server's own.

    Attributes:
        weights: name of the weights.
        folder: in which the files lie, and what is written for the answer.
        file: name of the depth image or point cloud in it.
        reading: how it is read; the paths in it lie in the folder too.
        isolation: what of it is left out.
        resolution: cells along the longest side.
        media: of the answer.
        joints: values that are known, by name.
    """

    weights: str
    folder: Path
    file: str
    reading: InputConfig
    isolation: IsolationConfig
    resolution: int
    media: Media
    joints: Mapping[str, Any] | None = None

    @property
    def path(self) -> Path:
        """Path of the frame's file."""
        return self.folder / self.file


@dataclass(frozen=True)
class Reply:
    """Answer to a frame, or a refusal.

    Attributes:
        status: HTTP's.
        body: content.
        media: its type.
        headers: further ones.
        seconds: that each stage took.
    """

    status: int
    body: bytes
    media: str = JSON
    headers: Mapping[str, str] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Ready:
    """What a process says first: that it is ready.

    Attributes:
        facts: what is known of each of its weights.
        precision: of the products, as settled: "auto" measures, and two processes might measure otherwise.
    """

    facts: tuple[dict[str, Any], ...]
    precision: Precision = "float32"


# --- refusals ---------------------------------------------------------------------------------------------------------

# A status of HTTP and one sentence, the same as the command line's where it is about a frame.

FULL = "{queue} frames wait already, as many as may: ask again in as many seconds as Retry-After says"

GOING = "the server is being stopped and takes no frames any more: ask another one, or again later"

CRASHED = (
    "the process that read this frame has ended over it, or took far too long: check the frame, or try another one"
)

FAULT = "the frame cannot be answered for a fault of the server, which has logged it: try another frame, or report it"
"""Message to a client about an error that is not its own; the log has the rest."""


class Refused(Exception):
    """Request that is not answered.

    Attributes:
        reply: answer to its client.
    """

    def __init__(self, status: int, sentence: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(sentence)
        self.reply = failed(status, sentence, headers)


def failed(status: int, sentence: str, headers: Mapping[str, str] | None = None) -> Reply:
    """Reply without an answer: ``{"error": sentence}``."""
    body = json.dumps({"error": sentence}, ensure_ascii=False).encode()
    return Reply(status, body, JSON, {} if headers is None else headers)
