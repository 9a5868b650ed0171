"""What a command leaves behind: facts for programs, and whether the object was recognized."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

NOT_RECOGNIZED = 3
"""Exit status of a command whose answer is not recognized as the object."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command that answers.

    Attributes:
        facts: content of the JSON object that ``--json`` prints.
        status: exit status.
    """

    facts: Mapping[str, Any]
    status: int = 0
