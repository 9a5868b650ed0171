"""What a recorded sequence is of: the content of ``recording.json``, checked when it is read."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.errors import first_problem, reason

INDEX = "recording.json"
"""Name of the file in a recording's folder."""

FORMAT = 1
"""Version of the folder; others are not read."""

MOST_BYTES = 2**24
"""Size above which an index is none: a frame takes 60 bytes."""

Text = Annotated[str, Field(max_length=500)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Level = Annotated[int, Field(ge=0, le=255)]


class _Block(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class RecordedFrame(_Block):
    """Frame of a recording: its file below ``frames``, when it was taken, and how many pixels show the object."""

    file: Annotated[str, Field(pattern=r"^[0-9]{1,9}\.png$")]
    time_s: Annotated[FiniteFloat, Field(ge=0)]
    points: Annotated[int, Field(ge=0)]


class RecordedSegment(_Block):
    """Segment of the recorded object: its name, colour, and whether its faces bound a solid."""

    name: Text
    color: tuple[Level, Level, Level]
    solid: bool


class RecordingIndex(_Block):
    """Content of ``recording.json``.

    Attributes:
        format: version of the folder.
        scene: name or file, as it was given.
        seed: of the sequence.
        rate_hz: frames per second.
        unit_m: metres in a scene unit.
        hidden_s: first and last time at which something may be in front of the object.
        sensor: name of the simulated camera.
        segments: in the order of their labels.
        nested: as in ``SegmentedMesh``.
        frames: in their order.
    """

    format: int
    scene: Text
    seed: Annotated[int, Field(ge=0)]
    rate_hz: Positive
    unit_m: Positive
    hidden_s: tuple[FiniteFloat, FiniteFloat]
    sensor: Text
    segments: Annotated[tuple[RecordedSegment, ...], Field(min_length=1, max_length=254)]
    nested: tuple[tuple[Text, Text], ...]
    frames: Annotated[tuple[RecordedFrame, ...], Field(min_length=1)]

    def check_segments(self) -> None:
        """Raise ``ValueError`` where the segments cannot be those of one object: the mesh knows the rules."""
        nothing, faces = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
        SegmentedMesh(tuple(Segment(s.name, s.color, nothing, faces, s.solid) for s in self.segments), self.nested)


def read_index(path: Path) -> RecordingIndex:
    """Index from its file; raises ``ValueError`` where it is none."""
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    try:
        if len(content) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES // 2**20} MB")
        json.loads(content)
        index = RecordingIndex.model_validate_json(content)
        if index.format != FORMAT:
            raise ValueError(f"its format is {index.format}; this mereo reads format {FORMAT}")
        index.check_segments()
    except ValidationError as error:
        raise ValueError(f"{path} is no recording: {first_problem(error)}: record the sequence again") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no recording ({reason(error)}): record the sequence again") from None
    return index
