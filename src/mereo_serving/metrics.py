"""Numbers of a running server, for Prometheus: who asked, what waits, and where the time goes."""

from collections.abc import Callable, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.exposition import generate_latest

SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
"""Bounds of the histograms of seconds: from reading a small cloud to a fit of draws on a busy machine."""

OTHER = "other"
"""Place of requests to nowhere: names that clients make up must not become series without end."""


class Metrics:
    """Numbers of one server, in a registry of its own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)  # memory and time of the server's own process, on Linux
        r = self.registry
        self._requests = Counter("mereo_requests", "Requests that were answered.", ["endpoint", "code"], registry=r)
        self._request_seconds = Histogram(
            "mereo_request_seconds",
            "Seconds from a request to its answer.",
            ["endpoint"],
            buckets=SECONDS,
            registry=r,
        )
        self._stages = Histogram(
            "mereo_stage_seconds", "Seconds of each stage of a frame.", ["stage"], buckets=SECONDS, registry=r
        )
        self._dropped = Counter("mereo_dropped_frames", "Frames nobody waited for any more.", ["reason"], registry=r)
        self._restarts = Counter("mereo_restarts", "Processes that had to be started again.", registry=r)
        self._waiting = Gauge("mereo_waiting_frames", "Frames that wait, their bodies included.", registry=r)
        self._alive = Gauge("mereo_processes", "Processes that are ready to answer.", registry=r)

    def watch(self, waiting: Callable[[], int], alive: Callable[[], int]) -> None:
        """Read these whenever the numbers are asked for."""
        self._waiting.set_function(lambda: float(waiting()))
        self._alive.set_function(lambda: float(alive()))

    def answered(self, endpoint: str, code: int, seconds: float) -> None:
        """Count a request."""
        self._requests.labels(endpoint, str(code)).inc()
        self._request_seconds.labels(endpoint).observe(seconds)

    def stages(self, seconds: Mapping[str, float]) -> None:
        """Add the stages of an answered frame."""
        for stage, spent in seconds.items():
            self._stages.labels(stage).observe(spent)

    def dropped(self, reason: str) -> None:
        """Count a frame that was dropped: "gone" clients, "timeout"."""
        self._dropped.labels(reason).inc()

    def restarted(self) -> None:
        """Count a process that was started again."""
        self._restarts.inc()

    def text(self) -> bytes:
        """All numbers as Prometheus reads them."""
        return generate_latest(self.registry)
