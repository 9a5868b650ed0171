"""What one busy process beside it costs an answer, by how OpenMP's threads wait: times of the fair share.

    python benchmarks/busy.py [--queries 40000] [--rounds 9] [--beside 1]

Each row is a process of its own that asks the shipped bunny, in turn with the machine to itself and beside processes
that never rest; seconds are medians over the rounds. Fair is the time alone if all threads that want to run shared the
cores evenly: (threads + busy processes) / cores times it, where that is above one. "not set" is OpenMP's own policy, as
a program has it that imports torch before mereo. Other work on the machine spoils the figures: the load is printed.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

SETTINGS = (("passive", None), ("passive", 1), ("active", None), (None, None))
"""OMP_WAIT_POLICY and OMP_NUM_THREADS of each row; None is not set."""

LIMIT = 1.5
"""Times of the fair share that an answer may take."""

BUSY = "import os; parent = os.getppid(); print('started', flush=True)\nwhile os.getppid() == parent: pass"
"""A process that never rests, and ends with whoever started it."""


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """That many run meanwhile, each on a core where there are enough."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE) for _ in range(count)]
    try:
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def measure(queries: int, rounds: int, beside: int) -> None:
    """Print threads, and seconds alone and beside busy processes: what the process of one row does."""
    import torch  # before mereo, so that OpenMP finds the variable as this row has it

    from mereo.models.weights import load_model
    from mereo.synthesis.sample_views import load_view
    from mereo_experiments.speed.stages import random_points

    model = load_model("bunny")
    view = load_view("bunny")
    code = model.encode(view.depth.to_points())
    points = random_points(view, queries, seed=1)

    def seconds() -> float:
        start = time.perf_counter()
        model.query(code, points)
        return time.perf_counter() - start

    seconds()  # the first one prepares
    alone, busy = [], []
    for _ in range(rounds):  # in turn, so that other work meets both
        alone.append(seconds())
        with busy_processes(beside):
            busy.append(seconds())
    print(torch.get_num_threads(), statistics.median(alone), statistics.median(busy))


def row(policy: str | None, threads: int | None, options: argparse.Namespace) -> float:
    """Print one row of the table; returns the times of the fair share."""
    from mereo.io.cores import cores

    variables = {
        name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "OMP_NUM_THREADS")
    }
    variables |= {} if policy is None else {"OMP_WAIT_POLICY": policy}
    variables |= {} if threads is None else {"OMP_NUM_THREADS": str(threads)}
    command = [
        sys.executable,
        __file__,
        "--measure",
        *(f"--{k}={vars(options)[k]}" for k in ("queries", "rounds", "beside")),
    ]
    told = subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
    used = int(told[0])
    alone = float(told[1])
    busy = float(told[2])
    fair = alone * max(1.0, (used + options.beside) / cores())
    print(f"| {policy or 'not set'} | {used} | {alone:.2f} | {fair:.2f} | {busy:.2f} | {busy / fair:.2f} |", flush=True)
    return busy / fair


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=int, default=40_000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--beside", type=int, default=1)
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        measure(options.queries, options.rounds, options.beside)
        return
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    print(f"{options.queries} queries, {options.beside} busy beside them, {os.cpu_count()} cores, {load} before\n")
    print("| OMP_WAIT_POLICY | threads | alone, s | fair, s | busy, s | times fair |\n|---|---|---|---|---|---|")
    shares = [row(policy, threads, options) for policy, threads in SETTINGS]
    if shares[0] > LIMIT:
        sys.exit(f"\npassive takes {shares[0]:.2f} times its fair share, above {LIMIT}")


if __name__ == "__main__":
    main()
