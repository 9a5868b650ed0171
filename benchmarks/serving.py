"""Many clients of ``mereo serve`` for a given time: are all answers right, when do they come, does memory grow?

    python benchmarks/serving.py --clients 8 --minutes 2 --method modes --output out/serving

The rival is the same frames one after the other in one process without HTTP, as `mereo reconstruct` takes a folder of
them: its answers are what each served one is compared with (all but seconds), its rate what the server's is measured
by. Frames are random parts of the shipped one of each weights. Everything is on this machine's loopback address. Prints
a summary, and writes it with the memory over time to serving.json. Linux only: memory is read from /proc.
"""

import argparse
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mereo.api.reconstruct import load_frame
from mereo.io.atomic_files import check_file_place, write_json
from mereo.io.config import InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig
from mereo_serving.messages import JSON, FrameRequest, Served, Setup
from mereo_serving.workers import WorkerProcess

HEADERS = {"Content-Type": "application/x-npy"}
PATIENCE_S = 120.0


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, and what is to be said of it; None where that is not known yet."""

    weights: str
    content: bytes
    answer: dict[str, Any] | None = None


def frames_of(weights: Sequence[str], count: int, folder: Path) -> list[Frame]:
    """Random parts of the shipped frame of each weights, as NPY files."""
    frames = []
    for name in weights:
        points = load_frame(name).cloud.points
        rng = np.random.default_rng(0)
        for _ in range(count):
            kept = np.sort(rng.choice(len(points), int(len(points) * rng.uniform(0.6, 1.0)), replace=False))
            np.save(folder / "frame.npy", points[kept])
            frames.append(Frame(name, (folder / "frame.npy").read_bytes()))
    return frames


def figures(content: bytes) -> dict[str, Any]:
    """What of an answer no clock decides."""
    found: dict[str, Any] = json.loads(content)
    found.get("registration", {}).pop("seconds", None)
    return {key: value for key, value in found.items() if key != "timings_s"}


def one_after_the_other(
    frames: Sequence[Frame], method: Any, resolution: int, folder: Path
) -> tuple[list[Frame], list[tuple[float, float]]]:
    """The frames with their answers, and seconds and processor seconds of each, in a process like the server's."""
    names = tuple(dict.fromkeys(frame.weights for frame in frames))
    setup = Setup(tuple(Served(name, name) for name in names), method, InferenceConfig(precision="float32"))
    worker = WorkerProcess(setup)
    answered = list[Frame]()
    seconds = list[tuple[float, float]]()
    worker.wait_until_ready()
    try:
        for frame in [*frames[:2], *frames]:  # the first ones load libraries
            (folder / "frame.npy").write_bytes(frame.content)
            reading = InputConfig()
            isolation = IsolationConfig()
            request = FrameRequest(frame.weights, folder, "frame.npy", reading, isolation, resolution, JSON)
            start = time.perf_counter()
            had = processor_s(worker.process.pid)
            reply = worker.ask(request)
            seconds.append((time.perf_counter() - start, processor_s(worker.process.pid) - had))
            assert reply.status == 200, reply.body
            answered.append(Frame(frame.weights, frame.content, figures(reply.body)))
    finally:
        worker.close()
    return answered[2:], seconds[2:]


@contextmanager
def served(*arguments: str, scratch: Path) -> Iterator[tuple[Any, int]]:
    """A server in a process of its own, and its port; it is ended by TERM, if it has not ended by itself."""
    command = [sys.executable, "-m", "mereo", "serve", "--port", "0", "--precision", "float32", *arguments]
    environment = {**os.environ, "TMPDIR": str(scratch)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
            if found is None:
                raise RuntimeError(f"mereo serve has ended with {process.wait()} before it said its address")
            yield process, int(found[1])
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()


@dataclass
class Tally:
    """What a client has seen."""

    latencies: list[float] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


def client(
    port: int, frames: Sequence[Frame], seed: int, wanted: Callable[[], bool], address: str, tally: Tally
) -> None:
    """Ask for frames in a random order while it is wanted; refused ones are asked for again."""
    rng = np.random.default_rng(seed)
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    while wanted():
        frame = frames[int(rng.integers(len(frames)))]
        start = time.perf_counter()
        try:
            line.request("POST", address.format(weights=frame.weights), frame.content, HEADERS)
            answer = line.getresponse()
            content = answer.read()
        except (OSError, http.client.HTTPException) as problem:
            tally.counts["lost"] += 1
            tally.counts[f"lost: {type(problem).__name__}"] += 1
            line.close()  # the next request opens it anew
            continue
        if answer.status == 200:
            tally.latencies.append(time.perf_counter() - start)
            tally.counts["right" if figures(content) == frame.answer else "wrong"] += 1
        else:
            tally.counts[str(answer.status)] += 1
            time.sleep(min(float(answer.headers.get("Retry-After", 1)), 2.0))
    line.close()


def load(
    port: int, frames: Sequence[Frame], clients: int, seconds: float, address: str, watch: Callable[[float], None]
) -> Tally:
    """All that clients have seen together; ``watch`` is called about every two seconds with the seconds so far."""
    end = time.monotonic() + seconds
    tallies = [Tally() for _ in range(clients)]
    threads = [
        threading.Thread(target=client, args=(port, frames, n, lambda: time.monotonic() < end, address, tally))
        for n, tally in enumerate(tallies)
    ]
    for thread in threads:
        thread.start()
    while (left := end - time.monotonic()) > 0:
        watch(seconds - left)
        time.sleep(min(2.0, left))
    for thread in threads:
        thread.join(PATIENCE_S)
    together = Tally()
    for tally in tallies:
        together.latencies += tally.latencies
        together.counts += tally.counts
    return together


def family(pid: int) -> list[int]:
    """A process and its children."""
    children = [word for file in Path(f"/proc/{pid}/task").glob("*/children") for word in file.read_text().split()]
    return [pid, *map(int, children)]


def resident_mb(pid: int) -> dict[int, float]:
    """Memory of a process and its children, in MB each."""
    pages = {one: int(Path(f"/proc/{one}/statm").read_text().split()[1]) for one in family(pid)}
    return {one: count * os.sysconf("SC_PAGE_SIZE") / 1e6 for one, count in pages.items()}


def processor_s(pid: int) -> float:
    """Processor time that a process and its children have had, which other work on the machine changes least."""
    fields = [Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split() for one in family(pid)]
    return sum(int(row[11]) + int(row[12]) for row in fields) / os.sysconf("SC_CLK_TCK")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that is printed and written."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = frames_of(options.weights, options.frames, folder)
        answered, alone = one_after_the_other(frames, options.method, options.resolution, folder)
        alone_s, alone_processor_s = map(np.array, zip(*alone, strict=True))
        weights = [word for one in options.weights for word in ("--weights", one)]
        more = ("--method", options.method, "--workers", str(options.workers))
        memory: list[tuple[float, float]] = []
        with served(*weights, *more, "--resolution", str(options.resolution), scratch=folder) as (process, port):
            address = "/v1/{weights}/reconstruct"
            load(port, answered, options.clients, 5.0, address, lambda _: None)  # libraries, caches
            start = time.monotonic()
            had = processor_s(process.pid)
            seen = load(
                port,
                answered,
                options.clients,
                60 * options.minutes,
                address,
                lambda seconds: memory.append((seconds, sum(resident_mb(process.pid).values()))),
            )
            spent, processor = time.monotonic() - start, processor_s(process.pid) - had
            each = resident_mb(process.pid)
    seconds, megabytes = map(np.array, zip(*memory, strict=True))
    late = seconds >= seconds[-1] / 2
    rate, rival = len(seen.latencies) / spent, 1 / float(np.mean(alone_s))
    return {
        "clients": options.clients,
        "seconds": spent,
        "answers": dict(seen.counts),
        "rate_hz": rate,
        "p50_ms": 1e3 * float(np.quantile(seen.latencies, 0.5)),
        "p99_ms": 1e3 * float(np.quantile(seen.latencies, 0.99)),
        "processor_ms": 1e3 * processor / max(len(seen.latencies), 1),
        "rival_rate_hz": rival,
        "rival_p50_ms": 1e3 * float(np.median(alone_s)),
        "rival_processor_ms": 1e3 * float(np.mean(alone_processor_s)),
        "times_the_rival": rate / rival,
        "memory_mb": {
            "first": megabytes[0],
            "half": float(megabytes[late][0]),
            "last": megabytes[-1],
            "most": float(megabytes.max()),
            "growth_mb_per_minute": 60 * float(np.polyfit(seconds[late], megabytes[late], 1)[0]),
            "each": list(each.values()),
            "over_time": memory,
        },
    }


def summary(found: dict[str, Any]) -> str:
    """Words for the figures."""
    memory = found["memory_mb"]
    counts = ", ".join(f"{count} {what}" for what, count in sorted(found["answers"].items()))
    return "\n".join(
        (
            f"{found['clients']} clients, {found['seconds']:.0f} s: {counts}",
            f"{found['rate_hz']:.2f} answers/s, p50 {found['p50_ms']:.0f} ms, p99 {found['p99_ms']:.0f} ms, "
            f"{found['processor_ms']:.0f} ms of processor time each",
            f"one at a time, no HTTP: {found['rival_rate_hz']:.2f}/s, median {found['rival_p50_ms']:.0f} ms, "
            f"{found['rival_processor_ms']:.0f} ms of processor time each",
            f"the server gives {found['times_the_rival']:.2f} times as many",
            f"memory: {memory['first']:.0f} MB at first, {memory['half']:.0f} MB after half of the time, "
            f"{memory['last']:.0f} MB at the end, at most {memory['most']:.0f} MB "
            f"({memory['growth_mb_per_minute']:+.1f} MB a minute in the second half)",
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Clients of mereo serve: right answers, latencies, memory.")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--weights", nargs="+", default=["bunny", "liver"], help="shipped ones that come with a frame")
    parser.add_argument("--frames", type=int, default=12, help="different ones of each weights")
    parser.add_argument("--method", choices=("network", "auto", "modes"), default="modes")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("out/serving"), help="folder for serving.json")
    parser.add_argument("--force", action="store_true", help="replace that file")
    options = parser.parse_args()
    place = options.output / "serving.json"
    check_file_place(place, force=options.force)
    found = measure(options)
    write_json(place, found, force=options.force)
    print(summary(found))
    print(f"wrote {place}")


if __name__ == "__main__":
    main()
