"""Checkpoints of a training run as safetensors: network, averaged network, optimizer and step. No pickles."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from mereo.io.atomic_files import atomic_file
from mereo.io.errors import reason
from mereo.training.processes import Process, told

NAME = "checkpoint.safetensors"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Objects whose state makes a run resumable; loading fills them in place."""

    step: int
    network: nn.Module
    average: nn.Module
    optimizer: torch.optim.Optimizer


def save_checkpoint(run_dir: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint atomically, so that a killed run keeps its previous one."""
    tensors: dict[str, Tensor] = {}
    for prefix, module in (("network", checkpoint.network), ("average", checkpoint.average)):
        tensors |= {f"{prefix}/{name}": value.contiguous() for name, value in module.state_dict().items()}
    for index, state in checkpoint.optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer/{index}/{name}": value.contiguous() for name, value in state.items()}
    with atomic_file(run_dir / NAME) as partial:
        partial.write_bytes(save(tensors, metadata={"step": str(checkpoint.step)}))


def load_checkpoint(run_dir: Path, checkpoint: Checkpoint, process: Process | None = None) -> int | None:
    """Fill network, average and optimizer; returns the step, or None when there is no checkpoint yet.

    Process 0 reads the file and sends it to the others: machines that share a folder may see an older file for a while.
    """
    path = run_dir / NAME
    content = told(process or Process(), lambda: path.read_bytes() if path.is_file() else None)
    if content is None:
        return None
    try:
        tensors = load(content)
        step = int(json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]["step"])
        _fill(checkpoint, tensors)
    except (SafetensorError, OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read ({reason(error)}); delete it to train from the start") from None
    return step


def _fill(checkpoint: Checkpoint, tensors: dict[str, Tensor]) -> None:
    """Give a checkpoint's objects their state; raises whatever torch does for one that is not theirs."""
    for prefix, module in (("network", checkpoint.network), ("average", checkpoint.average)):
        module.load_state_dict(_below(tensors, prefix + "/"))
    states: dict[int, dict[str, Tensor]] = {}
    for name, value in _below(tensors, "optimizer/").items():
        index, key = name.split("/")
        states.setdefault(int(index), {})[key] = value
    _check_optimizer(checkpoint.optimizer, states)
    groups = checkpoint.optimizer.state_dict()["param_groups"]
    checkpoint.optimizer.load_state_dict({"state": states, "param_groups": groups})


def _check_optimizer(optimizer: torch.optim.Optimizer, states: dict[int, dict[str, Tensor]]) -> None:
    """Raise ``ValueError`` for states that the optimizer would take now and fail over at its next step."""
    parameters = [value for group in optimizer.param_groups for value in group["params"]]
    for index, state in states.items():
        shapes = {"step": torch.Size(()), "exp_avg": parameters[index].shape, "exp_avg_sq": parameters[index].shape}
        if {name: value.shape for name, value in state.items()} != shapes:
            raise ValueError(f"the optimizer's state {index} is of another network")


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
