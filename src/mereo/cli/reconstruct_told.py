"""What a table of many frames says of each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.recognition import Known
from mereo.visualization.result_files import summary_of

KNOWN: Mapping[Known, str] = {True: "yes", False: "no", "unsure": "unsure"}
"""Words of a table for whether a frame shows the object."""


@dataclass(frozen=True)
class Told:
    """Row of a table about a frame, but for its name and folder.

    Attributes:
        answer: who answers.
        explained: share of the cloud that the registered model explains; "" without one.
        known: whether it shows the object.
        segments: how many of them were found.
        seconds: that the answer took.
        summary: content of its summary.json.
    """

    answer: str
    explained: str
    known: str
    segments: str
    seconds: float
    summary: Mapping[str, Any] = field(compare=False, repr=False)

    @classmethod
    def of(cls, found: Answer) -> "Told":
        """Row about an answer."""
        registration, segments = found.registration, found.reconstruction.segments
        return cls(
            answer="registered model" if found.taken else "network",
            explained="" if registration is None else f"{registration.explained:.1%}",
            known=KNOWN[found.recognition.known],
            segments=f"{sum(segment.voxels > 0 for segment in segments)} of {len(segments)}",
            seconds=found.reconstruction.seconds,
            summary=summary_of(found),
        )
