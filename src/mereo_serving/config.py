"""Settings of the server; light, so that the command line may import them."""

from dataclasses import dataclass

from mereo.io.bounds import Cells, Count, Positive, check_bounds


@dataclass(frozen=True)
class ServeConfig:
    """Limits of a server, so that no client and no crowd of them takes more than the machine has.

    Attributes:
        queue: frames that may wait, those whose bodies are still coming included; one more is refused (429).
        max_body_mb: largest body of a request, in megabytes of 10^6 bytes (413).
        max_points: most points of a frame, or measured pixels of a depth image (413).
        max_resolution: most cells along the longest side that a request may ask for (422).
        timeout: seconds in which a body must have come (408), and a frame must be answered (504).
    """

    queue: Count = 64
    max_body_mb: Positive = 64.0
    max_points: Count = 1_000_000
    max_resolution: Cells = 256
    timeout: Positive = 60.0

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def max_body(self) -> int:
        """Largest body in bytes."""
        return int(self.max_body_mb * 1e6)
