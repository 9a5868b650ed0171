"""Where work is spread to, as options say it."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mereo.io.bounds import Count, NotNegative

LOCAL = "local"
"""Address that means: a cluster of this machine alone, started for the run."""

RayAddress = Annotated[str | None, arg(metavar="local|auto|HOST:PORT")]
"""Option that names a Ray cluster."""


@dataclass(frozen=True)
class TaskResources:
    """What a task of a cluster has for itself.

    Attributes:
        cpus_per_task: CPUs of a task, and threads in which it computes; only with --ray.
        gpus_per_task: GPUs of a task, as 0.25 for a share of one; 0 computes on CPUs. Only with --ray.
    """

    cpus_per_task: Count = 1
    gpus_per_task: NotNegative = 0


ONE_CPU = TaskResources()


@dataclass(frozen=True)
class Cluster:
    """Ray cluster, and what each task there may use.

    Attributes:
        address: "local" for one of this machine that is started for the run, "auto" for the one that this machine is a
            node of, or HOST:PORT of that one; a cluster that was there before stays.
        cpus: of a task, which computes in as many threads.
        gpus: of a task.
        local_cpus: of a cluster that is started; 0 means one per core.
    """

    address: str = LOCAL
    cpus: int = 1
    gpus: float = 0.0
    local_cpus: int = 0

    @property
    def device(self) -> str:
        """Kind of device on which a task computes: "cuda" or "cpu"."""
        return "cuda" if self.gpus else "cpu"
