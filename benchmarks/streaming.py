"""Datasets larger than memory: the memory that streaming takes, its speed beside a dataset in memory, its mixing.

    python benchmarks/streaming.py make data/200k --examples 200000     # synthetic shards, no rendering
    python benchmarks/streaming.py train data/200k --data stream --steps 600
    python benchmarks/streaming.py mixing --examples 200000 --batch 6 40
    python benchmarks/streaming.py tables --examples 10000000

`make` writes half balls with few points and queries as `mereo generate` writes examples: same files, headers and
checksums. `train` takes steps of the preset `tiny`, or of another, and prints the memory of the process on its way.
`mixing` compares batches with those of a full shuffle. `tables` prints what grows with the number of shards.
"""

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mereo.io.checked_tensors import pack_tensors
from mereo.models.device import keep_freed_memory
from mereo.scenes.rest_pose import TEMPLATE_NODES
from mereo.synthesis.config import TEMPLATE
from mereo.synthesis.dataset_contents import dataset_key, shard_name
from mereo.training.config import PRESETS
from mereo.training.data_source import open_data
from mereo.training.orders import ShuffledOrder, StreamedOrder
from mereo.training.processes import Process
from mereo.training.run_directory import fit_config, start_network
from mereo.training.streaming import StreamingDataset
from mereo.training.trainer import Trainer

SHARD = 64
CPU = torch.device("cpu")


def half_balls(rng: np.random.Generator, count: int, points: int, queries: int) -> dict[str, np.ndarray]:
    """So many balls of two halves, seen from one side, as a shard has them."""
    radius = rng.uniform(5, 10, (count, 1, 1))
    center = np.concatenate([rng.uniform(-5, 5, (count, 1, 2)), rng.uniform(100, 200, (count, 1, 1))], axis=2)
    front = rng.normal(size=(count, points, 3))
    front /= np.linalg.norm(front, axis=2, keepdims=True)
    front[..., 2] = -np.abs(front[..., 2])
    cloud = center + radius * front
    low, high = cloud.min(axis=1, keepdims=True), cloud.max(axis=1, keepdims=True)
    middle, scale = (low + high) / 2, 2 / (high - low).max(axis=2, keepdims=True)
    offset = rng.uniform(-1.4, 1.4, (count, queries, 3))
    reach = np.linalg.norm(offset, axis=2, keepdims=True)
    inside = reach < 1
    return {
        "cloud": ((cloud - middle) * scale).astype(np.float32),
        "cloud_count": np.full(count, points, dtype=np.int32),
        "center": middle[:, 0],
        "scale": scale[:, 0, 0],
        "positions": ((center + radius * offset - middle) * scale).astype(np.float32),
        "labels": np.where(inside, 1 + (offset[..., :1] > 0), 0)[..., 0].astype(np.uint8),
        "distances": ((reach - 1) * radius * scale)[..., 0].astype(np.float32),
        "directions": (offset / reach).astype(np.float16),
        "rest": np.where(inside, offset, np.nan).astype(np.float16),
    }


def make(options: argparse.Namespace) -> None:
    """A dataset of so many examples."""
    options.folder.mkdir(parents=True)
    manifest = {
        "scene": "half-balls",
        "seed": 710_000,
        "examples": options.examples,
        "shard_size": SHARD,
        "version": "0",
        "any_roll": False,
        "unit_m": 0.01,
        "settings": {"sampling": {"per_segment": 0}},
        "segments": [{"name": name, "color": [90, 90, 200]} for name in ("left", "right")],
    }
    key = dataset_key(manifest)
    for number, first in enumerate(range(0, options.examples, SHARD)):
        count = min(SHARD, options.examples - first)
        tensors = half_balls(np.random.default_rng((710_000, number)), count, options.points, options.queries)
        content = pack_tensors(tensors, {"dataset": key, "first": first})
        (options.folder / shard_name(number)).write_bytes(content)
    template = np.zeros((2, *[TEMPLATE_NODES] * 3), dtype=np.float16)
    (options.folder / TEMPLATE).write_bytes(pack_tensors({"distance": template}, {"dataset": key}))
    (options.folder / "manifest.json").write_text(json.dumps(manifest))


def resident_mb() -> float:
    """Memory of this process now, in MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def train(options: argparse.Namespace) -> None:
    """Steps of a training on a dataset, with what they took."""
    keep_freed_memory()
    preset = PRESETS[options.preset]
    config = replace(preset, data=options.data, precision="float32", compile="off", holdout=128)
    if options.batch:
        config = replace(config, batch=options.batch)
    with tempfile.TemporaryDirectory() as place:
        before, started = resident_mb(), time.monotonic()
        config, data = open_data(options.folder, Path(place), config, CPU, Process())
        config = fit_config(config, data)
        network = start_network(config, data)
        if isinstance(data, StreamingDataset):
            data = data.surveyed(Path(place), Process())
        loop = Trainer(config, data, network, Path(place), Process(), CPU)
        opened, times, marks = time.monotonic() - started, [], []
        batches = loop.batches()
        for step in range(options.steps):
            began = time.monotonic()
            batch = next(batches)
            read = time.monotonic()
            if not options.feed_only:
                loop.train_step(batch)
            else:
                loop.step += 1
            times.append((read - began, time.monotonic() - began))
            if (step + 1) % max(1, options.steps // 6) == 0:
                marks.append(f"{step + 1}: {resident_mb():.0f}")
        batches.close()
    feed, whole = np.array(times[20:]).T
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"{options.data}, {len(data):,} examples, batch {config.batch}: ready in {opened:.1f} s; {before:.0f} MB then, "
        f"by step {', '.join(marks)}; at most {peak:.0f} MB\n"
        f"  {1 / whole.mean():.1f} steps/s; of a step the batch took {feed.mean() * 1e3:.1f} ms on average, "
        f"{np.median(feed) * 1e3:.1f} at the median, {feed.max() * 1e3:.1f} at most, {feed.sum() / whole.sum():.1%}"
    )


def mixing(options: argparse.Namespace) -> None:
    """Pairs of one shard in batches and in windows of steps, streamed and in a full shuffle."""
    shards = -(-options.examples // SHARD)
    for batch in options.batch:
        orders = {
            "streamed": StreamedOrder((SHARD,) * shards, batch, 0),
            "shuffled": ShuffledOrder(shards * SHARD, batch, 0),
        }
        steps = min(options.steps, shards * SHARD // batch)
        for name, order in orders.items():
            numbers = np.stack([order.index(step).numpy() // SHARD for step in range(steps)])
            counts = [np.bincount(row) for row in numbers]
            equal = np.mean([(c * (c - 1)).sum() / (batch * (batch - 1)) for c in counts])
            centered = (numbers - (shards - 1) / 2) / (shards / np.sqrt(12))
            within = np.mean([(row.sum() ** 2 - (row**2).sum()) / (batch * (batch - 1)) for row in centered])
            distinct = [len(np.unique(numbers[at : at + 100])) for at in range(0, steps - 99, 100)]
            print(
                f"batch {batch}, {name}: {equal:.2e} of the pairs in a batch are of one shard (chance: "
                f"{(SHARD - 1) / (shards * SHARD - 1):.2e}), shard numbers in one correlate by {within:+.4f}; 100 "
                f"steps meet {np.mean(distinct):.0f} of {shards:,} shards"
            )


def tables(options: argparse.Namespace) -> None:
    """Bytes that grow with the number of shards, and the time to go to a step in the middle."""
    shards = -(-options.examples // SHARD)
    names = tuple(shard_name(number) for number in range(shards))
    order = StreamedOrder(np.full(shards, SHARD), 40, 0)
    started = time.monotonic()
    block = next(order.blocks(range(40), range(options.examples // 80, options.examples // 40)))
    took = time.monotonic() - started
    arrays = [order.sizes, order.starts, *(a for p in order.passes.values() for a in (p.shards, p.ends))]
    print(
        f"{options.examples:,} examples in {shards:,} shards: names {sum(map(sys.getsizeof, names)) / 1e6:.1f} MB and "
        f"{sys.getsizeof(names) / 1e6:.1f} MB, sizes and {len(order.passes)} passes "
        f"{sum(a.nbytes for a in arrays) / 1e6:.1f} MB; the blocks of a step in the middle of a pass are known after "
        f"{took:.2f} s (first has {len(block.index)} examples)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = parser.add_subparsers(required=True)
    for name, run in (("make", make), ("train", train), ("mixing", mixing), ("tables", tables)):
        part = parts.add_parser(name)
        part.set_defaults(run=run)
        if name in ("make", "train"):
            part.add_argument("folder", type=Path)
        if name != "train":
            part.add_argument("--examples", type=int, default=200_000)
        if name == "make":
            part.add_argument("--points", type=int, default=64)
            part.add_argument("--queries", type=int, default=32)
        if name == "train":
            part.add_argument("--data", choices=("memory", "stream"), default="stream")
            part.add_argument("--preset", choices=tuple(PRESETS), default="tiny")
            part.add_argument("--batch", type=int, default=0)
            part.add_argument("--feed-only", action="store_true", help="read batches and learn nothing from them")
        if name == "mixing":
            part.add_argument("--batch", type=int, nargs="+", default=[6, 40])
        if name in ("train", "mixing"):
            part.add_argument("--steps", type=int, default=600)
    options = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    options.run(options)


if __name__ == "__main__":
    main()
