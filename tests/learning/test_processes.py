"""Processes and nodes, started by torchrun on this machine: they train what one process does, and fail as one.

Equal is: to rounding, because sums over processes are added in another order than those of one. Adam turns the rounding
of a gradient near zero into a step of the size of its rate, so that in single precision runs that differ in one bit
soon part (docs/many-machines.md). These compute in double precision, where equal runs stay together.
"""

import csv
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from safetensors.torch import load_file
from torch import Tensor, nn
from toy_data import write_toy_dataset

from mereo.geometry.conventions import Triple
from mereo_learning.processes import Process, SharedBatchNorm, share_statistics

TRAIN = (
    "--preset tiny --precision float32 --compile off --batch 8 --queries 48 --network.points 64 "
    "--network.width 48 --network.neighbors 8"
)
NODES = f"{TRAIN} --holdout 6 --offset-examples 0"

WORKER = """
import os, signal, sys
from dataclasses import fields, replace
from pathlib import Path
import torch
torch.set_default_dtype(torch.float64)
torch.Tensor.float = torch.Tensor.double
import mereo.__main__ as command_line
from mereo_learning import metrics_log, trainer
metrics_log.draw_curves = lambda rows, path: path.write_bytes(b"")
victim, fallen = os.environ.get("VICTIM"), Path("fallen")
original = trainer.Trainer.train_step
def doubled(value):
    return value.double() if isinstance(value, torch.Tensor) and value.is_floating_point() else value
def step(self, batch):
    batch = replace(batch, **{item.name: doubled(getattr(batch, item.name)) for item in fields(batch)})
    if os.environ.get("RANK", "0") == victim and self.step == 3 and not fallen.exists():
        fallen.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    original(self, batch)
trainer.Trainer.train_step = step
trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
sys.exit(command_line.main(sys.argv[1:]))
"""


QUIET = {"OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}


def train(folder: Path, output: str, options: str, nodes: int = 0, **more: str) -> list[str]:
    """Train in one process, or in two on each of so many nodes; what each node said."""
    (folder / "worker.py").write_text(WORKER)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    launcher = ["-m", "torch.distributed.run", "--nnodes", str(nodes), "--nproc-per-node", "2"]
    launcher += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", "mereo"]
    launcher += ["--local-addr", "127.0.0.1", "--max-restarts", "2"]
    arguments = ["worker.py", "train", "data", "--output", output, *f"{NODES} {options}".split()]
    command = [sys.executable, *(launcher if nodes else []), *arguments]
    places = {"cwd": folder, "env": os.environ | QUIET | more, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    started = [subprocess.Popen(command, text=True, **places) for _ in range(max(nodes, 1))]  # type: ignore[call-overload]
    said = [process.communicate(timeout=280)[0] for process in started]
    assert not any(process.returncode for process in started), "\n\n".join(text[-4000:] for text in said)
    return said


def differences(folder: Path, one: str, other: str) -> Triple:
    """How far two runs are apart: the first loss and the worst, each relative, and weights and their statistics."""
    tables = []
    for name in (one, other):
        with (folder / name / "metrics.csv").open() as file:
            tables.append([float(row["loss"]) for row in csv.DictReader(file)])
    apart = [abs(a - b) / abs(a) for a, b in zip(*tables, strict=True)]
    first, second = (load_file(folder / name / "checkpoint.safetensors") for name in (one, other))
    assert first.keys() == second.keys()
    moved = [float((first[name] - second[name]).abs().max()) for name in first if name.startswith("network/")]
    return apart[0], max(apart), max(moved)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 70 examples in shards of 32, 32 and 6."""
    folder = tmp_path_factory.mktemp("nodes")
    write_toy_dataset(folder / "data", examples=70)
    return folder


@pytest.mark.slow
def test_two_nodes_train_what_one_process_does(folder: Path) -> None:
    train(folder, "alone", "--epochs 2")
    train(folder, "nodes", "--epochs 2", nodes=2)
    first, losses, weights = differences(folder, "alone", "nodes")
    assert first < 1e-12 and losses < 1e-8 and weights < 1e-7


@pytest.mark.slow
def test_a_killed_worker_is_started_again_and_ends_with_the_same_result(folder: Path) -> None:
    """All processes start again, from the latest checkpoint; the first ones end with one sentence."""
    train(folder, "whole", "--epochs 1", nodes=2)
    said = train(folder, "parts", "--epochs 1", nodes=2, VICTIM="3")
    assert (folder / "fallen").is_file(), "one was killed"
    assert any("continuing from step 3 of 8" in text for text in said), said
    assert not any("this is a fault of mereo" in text for text in said), said
    _, losses, weights = differences(folder, "whole", "parts")
    assert losses < 1e-8 and weights < 1e-7


FAILS = """
import errno, os, sys
import mereo.__main__ as command_line
from mereo_learning import trainer
from mereo.io.atomic_files import atomic_file
def full(run_dir, checkpoint):
    with atomic_file(run_dir / "checkpoint.safetensors"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
trainer.save_checkpoint = full
trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
sys.exit(command_line.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_full_disk_at_a_checkpoint_ends_all_with_one_sentence(tmp_path: Path) -> None:
    write_toy_dataset(tmp_path / "data", examples=32)
    (tmp_path / "fails.py").write_text(FAILS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "fails.py"]
    command += f"train data --output run {TRAIN} --epochs 2 --holdout 0".split()
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | QUIET, capture_output=True, text=True, timeout=120)
    said = [line for line in done.stderr.splitlines() if line.startswith("mereo: ")]
    assert done.returncode != 0 and len(said) == 1, done.stderr
    assert said[0].startswith("mereo: error: the disk is full while writing run/checkpoint.safetensors"), said
    assert "Traceback" not in done.stderr.partition("torch/distributed")[0], done.stderr
    assert not list((tmp_path / "run").glob(".*"))


CPU = torch.device("cpu")


@pytest.fixture
def group(tmp_path: Path) -> Iterator[None]:
    """Group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'meet'}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def learnt(norm: nn.Module, rows: Tensor, gradient: Tensor) -> list[Tensor]:
    """Outputs, all gradients, and running statistics of a step."""
    rows = rows.clone().requires_grad_()
    out = norm(rows)
    out.backward(gradient)
    assert isinstance(norm, nn.BatchNorm1d) and rows.grad is not None
    assert norm.weight.grad is not None and norm.bias.grad is not None
    assert norm.running_mean is not None and norm.running_var is not None
    found = [out, rows.grad, norm.weight.grad, norm.bias.grad, norm.running_mean, norm.running_var]
    return [value.detach().double() for value in found]


@pytest.mark.usefixtures("group")
@pytest.mark.parametrize("spreads", [0.0, 10.0, 100.0])
def test_it_is_torchs_and_no_less_exact(spreads: float) -> None:
    rng = torch.Generator().manual_seed(0)
    rows = torch.randn(384, 8, generator=rng) + spreads * torch.randn(8, generator=rng)
    gradient = torch.randn(384, 8, generator=rng)
    weight = torch.rand(8, generator=rng) + 0.5

    def norm(dtype: torch.dtype, shared: bool) -> nn.Module:
        made = nn.BatchNorm1d(8, dtype=dtype)
        made.weight.data.copy_(weight)
        return share_statistics(nn.Sequential(made), Process(0, 2), CPU)[0] if shared else made  # type: ignore[index]

    truth = learnt(norm(torch.float64, False), rows.double(), gradient.double())
    ours, torchs = (learnt(norm(torch.float32, shared), rows, gradient) for shared in (True, False))
    for mine, theirs, value in zip(ours, torchs, truth, strict=True):
        error, other = ((found - value).norm() / value.norm() for found in (mine, theirs))
        assert error < 1e-6 + other


@pytest.mark.usefixtures("group")
def test_in_use_it_has_its_running_statistics_and_one_process_keeps_torchs() -> None:
    norm = nn.BatchNorm1d(4)
    rows = torch.rand(16, 4)
    shared = share_statistics(nn.Sequential(norm), Process(0, 2), CPU).eval()
    assert isinstance(norm, SharedBatchNorm) and norm.num_batches_tracked == 0
    assert torch.allclose(shared(rows), rows / (1 + norm.eps) ** 0.5)
    shared.train()(rows)
    assert norm.num_batches_tracked == 1 and list(norm.state_dict()) == list(nn.BatchNorm1d(4).state_dict())
    network = nn.Sequential(nn.BatchNorm1d(4))
    assert share_statistics(network, Process(), CPU) is network and type(network[0]) is nn.BatchNorm1d
