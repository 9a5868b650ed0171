"""Refusals: a status of HTTP and one sentence, the same as the command line's where it is about a frame."""

import json
from collections.abc import Mapping

from mereo_serving.messages import JSON, Reply

FULL = "{queue} frames wait already, as many as may: ask again in as many seconds as Retry-After says"

GOING = "the server is being stopped and takes no frames any more: ask another one, or again later"

CRASHED = (
    "the process that read this frame has ended over it, or took far too long: check the frame, or try another one"
)

FAULT = "the frame cannot be answered for a fault of the server, which has logged it: try another frame, or report it"
"""What a client is told of an error that is not its own; the log has the rest."""


class Refused(Exception):
    """Request that is not answered.

    Attributes:
        reply: what its client is told.
    """

    def __init__(self, status: int, sentence: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(sentence)
        self.reply = failed(status, sentence, headers)


def failed(status: int, sentence: str, headers: Mapping[str, str] | None = None) -> Reply:
    """Reply without an answer: ``{"error": sentence}``."""
    body = json.dumps({"error": sentence}, ensure_ascii=False).encode()
    return Reply(status, body, JSON, {} if headers is None else headers)
