"""The three encoders at the paper's sizes: parameters, seconds of one core, memory.

    python benchmarks/encoders.py [ENCODER ...]

Each runs in a process of its own on one core; seconds are processor time, so other work beside it counts little.
Training: random clouds of 1,024 points, 1,472 queries each as for five segments, a batch of 8, forward and backward.
Encoding: one cloud of 1,024 points. Memory: the highest resident size while training, above that before.
"""

import multiprocessing
import resource
import sys
import time
from collections.abc import Callable

import torch

from mereo.models.config import Encoder, NetworkConfig
from mereo.models.encoders import Autodecoder
from mereo.models.network import Network
from mereo_learning.config import PRESETS

BATCH, QUERIES, SEGMENTS = 8, 1472, 5
ENCODERS: tuple[Encoder, ...] = ("pointnet2", "point-transformer", "autodecoder")


def measure(encoder: Encoder) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = Network(
        NetworkConfig().changed(encoder=encoder, dropout=0.2 if encoder == "autodecoder" else 0.0), SEGMENTS
    )
    parts = [sum(p.numel() for p in part.parameters()) / 1e6 for part in (network.encoder, network.decoder)]
    if isinstance(network.encoder, Autodecoder):
        network.encoder.add_codes(BATCH, length=1.0)
    cloud = torch.nn.functional.normalize(torch.randn(BATCH, network.config.points, 3), dim=-1)
    viewpoint = torch.tensor([[0.0, 0.0, -8.0]])
    queries = torch.randn(BATCH, QUERIES, 3)
    index = torch.arange(BATCH)

    def step() -> None:
        prediction, coarse = network(cloud, viewpoint.expand(BATCH, 3), queries, index)
        torch.stack([output.square().mean() for output in (*prediction, coarse) if output is not None]).sum().backward()

    before = peak()
    training = seconds(step, 3) / BATCH
    memory = peak() - before
    network.eval().requires_grad_(False)
    encoding = seconds(lambda: network.encode(cloud[:1], viewpoint), 2)
    print(f"{encoder:18} {parts[0]:8.2f} + {parts[1]:.2f} {training:18.3f} {encoding:15.3f} {memory / BATCH:17.0f}")


def seconds(work: Callable[[], object], times: int) -> float:
    """Processor time of one call, after one to warm up."""
    work()
    start = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - start) / times


def peak() -> float:
    """In MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(names: list[str]) -> None:
    print(f"preset {PRESETS['paper'].network.points} points; seconds of one core")
    print("encoder            parameters (M)   training, /example    encode, /cloud   memory, MB/example")
    for name in names or ENCODERS:
        process = multiprocessing.get_context("spawn").Process(target=measure, args=(name,))
        process.start()
        process.join()
        if process.exitcode:
            sys.exit(process.exitcode)


if __name__ == "__main__":
    main(sys.argv[1:])
