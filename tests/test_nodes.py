"""Two nodes of two processes, started by torchrun on this machine: they train what one process does.

Equal is: to rounding. Sums over processes are added in another order than those of one process, and Adam turns the
rounding of a gradient near zero into a step of the size of the rate, so single weights may part; what the network says
may not (docs/clusters.md).
"""

import csv
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from toy_data import write_toy_dataset

from mereo.models.weights import load_model

TRAIN = (
    "--preset tiny --precision float32 --compile off --batch 8 --queries 48 --epochs 2 --network.points 64 "
    "--network.width 48 --network.neighbors 8 --holdout 6 --offset-examples 0"
)
PLAIN = "--network.align-points 0 --network.no-rest-template --network.local-neighbors 0 --network.sight-neighbors 0"
"""Network without choices (of neighbours, of an alignment), which rounding may turn."""

WORKER = """
import os, signal, sys
from dataclasses import fields, replace
from pathlib import Path
import torch
torch.set_default_dtype(torch.float64)
torch.Tensor.float = torch.Tensor.double
import mereo.__main__ as command_line
from mereo.training import trainer
victim, fallen = os.environ.get("VICTIM"), Path("fallen")
original = trainer.Trainer.train_step
def doubled(value):
    return value.double() if isinstance(value, torch.Tensor) and value.is_floating_point() else value
def step(self, batch):
    batch = replace(batch, **{item.name: doubled(getattr(batch, item.name)) for item in fields(batch)})
    if os.environ["RANK"] == victim and self.step == 6 and not fallen.exists():
        fallen.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    original(self, batch)
trainer.Trainer.train_step = step
trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
sys.exit(command_line.main(sys.argv[1:]))
"""


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1", **more}


def train_on_nodes(folder: Path, output: str, options: str, nodes: int = 2, **more: str) -> list[str]:
    """Train in two processes on each of so many nodes; what each node said."""
    (folder / "worker.py").write_text(WORKER)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nnodes", str(nodes), "--nproc-per-node", "2"]
    launcher += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", "mereo"]
    launcher += ["--local-addr", "127.0.0.1", "--max-restarts", "2", "worker.py"]
    command = [*launcher, "train", "data", "--output", output, *f"{TRAIN} {options}".split()]
    started = [
        subprocess.Popen(
            command, cwd=folder, env=environment(**more), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for _ in range(nodes)
    ]
    said = [process.communicate(timeout=280)[0] for process in started]
    assert [process.returncode for process in started] == [0] * nodes, "\n\n".join(text[-4000:] for text in said)
    return said


def train_alone(folder: Path, output: str, options: str) -> None:
    command = [sys.executable, "-m", "mereo", "train", "data", "--output", output, *f"{TRAIN} {options}".split()]
    subprocess.run(command, cwd=folder, env=environment(), check=True, capture_output=True, timeout=280)


def losses(run: Path) -> torch.Tensor:
    with (run / "metrics.csv").open() as file:
        return torch.tensor([float(row["loss"]) for row in csv.DictReader(file)], dtype=torch.float64)


def answers(run: Path) -> torch.Tensor:
    """Distances that the trained network states at fixed places."""
    model = load_model(run / "weights.safetensors")
    rng = torch.Generator().manual_seed(0)
    front = torch.nn.functional.normalize(torch.randn(200, 3, generator=rng), dim=1) * 7
    front[:, 2] = -front[:, 2].abs()
    center = torch.tensor([1.0, 2.0, 150.0])
    places = center + 20 * torch.rand(400, 3, generator=rng) - 10
    answer = model.query(model.encode((center + front).numpy()), places.numpy())
    return torch.from_numpy(answer.distance).double() / 7


def differences(folder: Path, one: str, other: str) -> dict[str, float]:
    """How far two runs are apart: losses relative to each, answers relative to the ball's radius."""
    first, second = losses(folder / one), losses(folder / other)
    assert len(first) == len(second)
    apart = (first - second).abs() / first.abs()
    weights = [load_file(folder / name / "weights.safetensors") for name in (one, other)]
    found = {
        "first loss": float(apart[0]),
        "losses": float(apart.max()),
        "answers": float((answers(folder / one) - answers(folder / other)).abs().max()),
        "weights": max(
            float((weights[0][n] - weights[1][n]).abs().max()) for n in weights[0] if weights[0][n].is_floating_point()
        ),
    }
    print(one, other, json.dumps(found))
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 70 examples in shards of 32, 32 and 6."""
    folder = tmp_path_factory.mktemp("nodes")
    write_toy_dataset(folder / "data", examples=70)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("options", [PLAIN, f"--data stream {PLAIN}", f"--data stream --accumulate 2 {PLAIN}"], ids=["memory", "stream", "parts"])
def test_two_nodes_train_what_one_process_does(folder: Path, options: str) -> None:
    name = options.replace(" ", "").replace("-", "")
    train_alone(folder, f"alone{name}", options)
    train_on_nodes(folder, f"nodes{name}", options)
    apart = differences(folder, f"alone{name}", f"nodes{name}")
    assert apart["first loss"] < 1e-6 and apart["losses"] < 2e-3 and apart["answers"] < 0.02, apart


@pytest.mark.slow
def test_a_killed_worker_is_started_again_and_ends_with_the_same_result(folder: Path) -> None:
    """All processes start again, from the latest checkpoint; the first ones end with one sentence."""
    train_on_nodes(folder, "whole", "--data stream")
    said = train_on_nodes(folder, "parts", "--data stream", VICTIM="3")
    assert (folder / "fallen").is_file(), "one was killed"
    assert any("continuing from step 6 of 16" in text for text in said), said
    assert not any("this is a fault of mereo" in text for text in said), said
    apart = differences(folder, "whole", "parts")
    assert apart["losses"] < 2e-3 and apart["answers"] < 0.02, apart
    assert len(losses(folder / "parts")) == 16
