"""Long-lived commands for a given time: does memory grow, do answers come later? ``mereo stream`` and ``mereo view``.

    python benchmarks/soak.py --minutes 120 --output out/soak

The stream watches a folder in which the same few frames are written again and again; a client of the viewer opens its
page, waits for the first message of the scene and leaves it open until so many others are (--held). All is on this
machine's loopback address, at the given rates and for the given time, and the disk holds as much at the end as at the
start. It writes soak.csv (a row for each command and interval) and soak.png, and prints for each command its memory,
how much it grows by the hour (a line through the second half) and its latencies. Linux only: memory is read from /proc.
"""

import argparse
import csv
import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.extras import pyplot
from mereo.synthesis.sample_views import load_view

FRAMES = 8
"""Files in the watched folder; each is another random part of one frame."""

COLUMNS = ("command", "minutes", "rss_mb", "answers", "median_ms", "worst_ms")


@dataclass
class Watched:
    """A command, its latencies since the last row and its rows."""

    name: str
    process: "subprocess.Popen[str]"
    latencies: "queue.Queue[float]" = field(default_factory=queue.Queue)
    rows: list[tuple[float, float, int, float, float]] = field(default_factory=list)

    def measure(self, minutes: float) -> None:
        """Add a row; ``RuntimeError`` where the command has ended."""
        if self.process.poll() is not None:
            raise RuntimeError(f"{self.name} has ended with {self.process.returncode} after {minutes:.1f} minutes")
        found = [self.latencies.get() for _ in range(self.latencies.qsize())]
        median, worst = (float(np.median(found)), max(found)) if found else (np.nan, np.nan)
        self.rows.append((minutes, resident_mb(self.process.pid), len(found), 1e3 * median, 1e3 * worst))

    def summary(self) -> str:
        """Sentence on memory and latency."""
        minutes, rss, answers, medians, worst = map(np.array, zip(*self.rows, strict=True))
        late = minutes >= minutes[-1] / 2
        growth = 60 * np.polyfit(minutes[late], rss[late], 1)[0] if late.sum() > 2 else np.nan
        halves = [np.nanmedian(medians[part]) if part.any() else np.nan for part in (~late, late)]
        return (
            f"{self.name}: {answers.sum():.0f} answers in {minutes[-1]:.1f} minutes; memory {rss[0]:.0f} MB at first, "
            f"{rss[late][0]:.0f} MB after half of the time, {rss[-1]:.0f} MB at the end, at most {rss.max():.0f} MB "
            f"({growth:+.1f} MB/h in the second half); latency {halves[0]:.0f} ms (median, first half), "
            f"{halves[1]:.0f} ms (second half), {np.nanmax(worst):.0f} ms at worst"
        )


def resident_mb(pid: int) -> float:
    """Memory of a process that is really there, in MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def command(*arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """A command of mereo that is interrupted at the end, as by Ctrl-C."""
    with subprocess.Popen([sys.executable, "-m", "mereo", *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()


def every(seconds: float, end: threading.Event, work: Callable[[int], None]) -> None:
    """Do work again and again at a steady rate, until the end."""
    number = 0
    while not end.wait(seconds):
        work(number)
        number += 1


def write_frames(folder: Path, weights: str) -> Callable[[int], None]:
    """Work that writes the next frame into a folder, over an older one."""
    points = load_view(weights).depth.to_points().points

    def write(number: int) -> None:
        rng = np.random.default_rng([0, number % FRAMES])
        chosen = rng.choice(len(points), int(len(points) * rng.uniform(0.5, 1.0)), replace=False)
        with atomic_file(folder / f"{number % FRAMES}.npy") as partial, partial.open("wb") as file:
            np.save(file, points[np.sort(chosen)])

    return write


def read_answers(watched: Watched) -> None:
    """Take the latency out of every line of a stream."""
    assert watched.process.stdout is not None
    for line in watched.process.stdout:
        watched.latencies.put(json.loads(line)["latency_ms"] / 1e3)


def page_opener(watched: Watched, held: int) -> Callable[[int], None]:
    """Work that opens the viewer's page as a browser does, and leaves the oldest where more than ``held`` are open.

    Pages that overlap are the harder test: what belongs to a page that was open for long is collected late.
    """
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    assert watched.process.stdout is not None
    for line in watched.process.stdout:
        if found := re.search(r"http://127\.0\.0\.1:(\d+)", line):
            break
    else:
        raise RuntimeError("mereo view has ended before it said its address")
    address = f"127.0.0.1:{found[1]}"
    pages = deque[Any]()

    def open_page(_: int) -> None:
        start = time.perf_counter()
        protocol = [Subprotocol(f"viser-v{viser.__version__}")]
        origin = Origin(f"http://{address}")
        page = connect(f"ws://{address}", origin=origin, subprotocols=protocol, max_size=None)
        page.recv(timeout=60)
        watched.latencies.put(time.perf_counter() - start)
        pages.append(page)
        if len(pages) > held:
            pages.popleft().close()

    return open_page


def soak(options: argparse.Namespace) -> list[Watched]:
    """Run both commands for the given time; rows are added at every interval."""
    end = threading.Event()
    threads = list[threading.Thread]()
    with (
        tempfile.TemporaryDirectory() as folder,
        command(
            *("stream", folder, "--watch", "--weights", options.weights, "--resolution", str(options.resolution))
        ) as stream,
        command("view", "--weights", options.weights, "--port", "0", "--resolution", "48") as view,
    ):
        both = [Watched("mereo stream", stream), Watched("mereo view", view)]
        opener = page_opener(both[1], options.held)
        for target, arguments in (
            (read_answers, (both[0],)),
            (every, (1 / options.rate, end, write_frames(Path(folder), options.weights))),
            (every, (1 / options.pages, end, opener)),
        ):
            threads.append(threading.Thread(target=target, args=arguments, daemon=True))
            threads[-1].start()
        try:
            _measure(both, options)
        finally:
            end.set()
            for thread in threads[1:]:
                thread.join(60)
    return both


def _measure(both: list[Watched], options: argparse.Namespace) -> None:
    start = time.monotonic()
    while (minutes := (time.monotonic() - start) / 60) < options.minutes:
        time.sleep(min(options.interval, 60 * (options.minutes - minutes)))
        for watched in both:
            watched.measure((time.monotonic() - start) / 60)


def write_table(path: Path, both: list[Watched]) -> None:
    """Write a row for each command and interval."""
    with atomic_file(path) as partial, partial.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows((watched.name, *(f"{value:.6g}" for value in row)) for watched in both for row in watched.rows)


def draw(path: Path, both: list[Watched]) -> None:
    """Draw memory and latencies against time."""
    plt = pyplot()
    figure, panels = plt.subplots(2, len(both), figsize=(11, 6), sharex=True, layout="constrained", squeeze=False)
    for watched, (memory, latency) in zip(both, panels.T, strict=True):
        minutes, rss, _, median, worst = zip(*watched.rows, strict=True)
        memory.plot(minutes, rss)
        memory.set(title=watched.name, ylabel="memory (RSS), MB", ylim=(0, 1.1 * max(rss)))
        latency.plot(minutes, median, label="median")
        latency.plot(minutes, worst, label="worst", linewidth=0.7)
        latency.set(xlabel="minutes", ylabel="latency, ms", yscale="log")
        latency.legend()
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description="Memory and latency of the long-lived commands.")
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--interval", type=float, default=10.0, help="seconds between two rows")
    parser.add_argument("--rate", type=float, default=2.0, help="frames per second that are written, at most 30")
    parser.add_argument("--pages", type=float, default=0.5, help="pages per second that are opened, at most 10")
    parser.add_argument("--held", type=int, default=20, help="pages that are open at the same time, at most 200")
    parser.add_argument("--weights", default="rope", help="shipped weights that come with a frame")
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--output", type=Path, default=Path("out/soak"), help="folder for soak.csv and soak.png")
    parser.add_argument("--force", action="store_true", help="replace these two files")
    options = parser.parse_args()
    if not (0 < options.minutes <= 10_000 and 0 < options.rate <= 30 and 0 < options.pages <= 10):
        parser.error("--minutes is up to 10000, --rate up to 30 and --pages up to 10, and none is 0")
    if not (0 <= options.held <= 200):
        parser.error("--held is from 0 to 200")
    places = [options.output / name for name in ("soak.csv", "soak.png")]
    for place in places:
        check_file_place(place, force=options.force)
    both = soak(options)
    write_table(places[0], both)
    draw(places[1], both)
    for watched in both:
        print(watched.summary())
    print(f"wrote {places[0]} and {places[1]}")


if __name__ == "__main__":
    main()
