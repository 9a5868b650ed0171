"""Whether work is done here, in processes or on a cluster: the one place that chooses."""

from collections.abc import Callable, Generator, Iterable

from mereo.workers.config import Cluster
from mereo.workers.processes import Function, Item, Result, in_processes
from mereo.workers.tasks import in_tasks


def spread(
    function: Function[Item, Result],
    items: Iterable[Item],
    workers: int = 1,
    cluster: Cluster | None = None,
    lost: Callable[[Item, ChildProcessError], Result] | None = None,
) -> Generator[tuple[Item, Result], None, None]:
    """Apply ``function`` to every item; yields each with its result, in any order. Close the generator to stop early.

    Without a cluster as ``in_processes`` does, and with one as ``in_tasks``, whatever ``workers`` is; only there are
    ``items`` taken as they are needed.
    """
    return in_processes(function, list(items), workers) if cluster is None else in_tasks(function, items, cluster, lost)


def in_order(found: Generator[tuple[int, Result], None, None]) -> Generator[Result, None, None]:
    """Results of the items 0, 1, 2, ... in this order, each as soon as those before it are there."""
    early: dict[int, Result] = {}
    following = 0
    for number, result in found:
        early[number] = result
        while following in early:
            yield early.pop(following)
            following += 1
