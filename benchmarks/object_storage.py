"""Writing and reading a dataset's shards: a local S3 server (moto, in its own process) against a local folder.

    python benchmarks/object_storage.py [--shards 60] [--rounds 3] [--output .]

Prints MB/s of both; shards are read by their own checksums. moto is Python on this machine's cores: a ratio, which says
nothing of a real storage.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mereo.io.atomic_files import json_text
from mereo.io.checked_tensors import pack_tensors
from mereo.io.object_storage import Place, place_of, write_whole
from mereo.scenes.rest_pose import TEMPLATE_NODES
from mereo.synthesis.config import TEMPLATE
from mereo_learning.dataset import Dataset
from mereo_learning.shards import MANIFEST, dataset_key, shard_name

EXAMPLES, POINTS, QUERIES = 64, 1024, 1536
"""Of a shard."""

SEED = 710_000

SERVER = """
import logging, sys
from moto.server import ThreadedMotoServer
logging.getLogger("werkzeug").setLevel(logging.ERROR)
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
"""


@contextmanager
def local_storage(bucket: str) -> Iterator[None]:
    """S3 on a free port of this machine, with an empty bucket, until the block ends."""
    with subprocess.Popen([sys.executable, "-c", SERVER], stdin=-1, stdout=-1, text=True) as server:
        assert server.stdin is not None and server.stdout is not None
        os.environ |= {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{int(server.stdout.readline())}",
            "AWS_ACCESS_KEY_ID": "nobody",
            "AWS_SECRET_ACCESS_KEY": "nothing",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
        }
        import s3fs

        s3fs.S3FileSystem().mkdir(bucket)
        try:
            yield
        finally:
            server.stdin.close()


def make(shards: int) -> tuple[dict[str, Any], list[bytes]]:
    """Manifest and shards of a dataset of random numbers."""
    manifest: dict[str, Any] = {
        "scene": "random",
        "segments": [{"name": "all", "color": [1, 2, 3]}],
        "settings": {"sampling": {"per_segment": 0}},
        "any_roll": False,
        "seed": SEED,
        "examples": shards * EXAMPLES,
        "shard_size": EXAMPLES,
        "version": "0",
    }
    rng = np.random.default_rng(SEED)
    key = dataset_key(manifest)
    return manifest, [pack_tensors(shard(rng), {"dataset": key, "first": n * EXAMPLES}) for n in range(shards)]


def shard(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Tensors of a shard, all random."""
    queries = (EXAMPLES, QUERIES)
    return {
        "cloud": rng.random((EXAMPLES, POINTS, 3), dtype=np.float32),
        "cloud_count": np.full(EXAMPLES, POINTS, np.int32),
        "center": rng.random((EXAMPLES, 3)),
        "scale": rng.random(EXAMPLES) + 1.0,
        "positions": rng.random((*queries, 3), dtype=np.float32),
        "labels": rng.integers(0, 2, queries).astype(np.uint8),
        "distances": rng.random(queries, dtype=np.float32),
        "directions": rng.random((*queries, 3)).astype(np.float16),
        "rest": rng.random((*queries, 3)).astype(np.float16),
    }


def rates(place: Place, manifest: dict[str, Any], shards: list[bytes]) -> tuple[float, float]:
    """MB/s of writing and of reading."""
    megabytes = sum(map(len, shards)) / 1e6
    began = time.perf_counter()
    for number, content in enumerate(shards):
        write_whole(place / shard_name(number), content)
    written = megabytes / (time.perf_counter() - began)
    template = {"distance": np.zeros((1, *(TEMPLATE_NODES,) * 3), np.float16)}
    write_whole(place / TEMPLATE, pack_tensors(template, {"dataset": dataset_key(manifest)}))
    write_whole(place / MANIFEST, json_text(manifest).encode())
    began = time.perf_counter()
    Dataset.load(place)
    return written, megabytes / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shards", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path(), help="folder whose disk is measured")
    options = parser.parse_args()
    manifest, shards = make(options.shards)
    print(f"{len(shards)} shards of {len(shards[0]) / 1e6:.2f} MB, load {os.getloadavg()[0]:.1f}, MB/s\n")
    print("| | write | read |\n|---|---|---|")
    with tempfile.TemporaryDirectory(dir=options.output) as folder, local_storage("bucket"):
        for number in range(options.rounds):
            for kind, place in (("folder", Path(folder) / str(number)), ("S3", place_of(f"s3://bucket/{number}"))):
                print(
                    f"| {kind} | {' | '.join(f'{rate:.0f}' for rate in rates(place, manifest, shards))} |", flush=True
                )


if __name__ == "__main__":
    main()
