"""Directory of a training run: its settings and checkpoint, the network it starts from and the model it ends with."""

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from mereo.io.atomic_files import write_file
from mereo.io.errors import reason
from mereo.io.object_storage import claim
from mereo.models.config import NetworkConfig
from mereo.models.encoders import Autodecoder
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import load_model
from mereo_learning.config import AugmentConfig, TrainConfig
from mereo_learning.dataset import Dataset
from mereo_learning.processes import Process, broadcast_result, meeting


def fit_config(config: TrainConfig, data: Dataset) -> TrainConfig:
    """Recipe with what the dataset decides: what can be held out, whether a roll is plausible, what else is observed.

    Raises ``ValueError`` for settings with which an autodecoder cannot be trained.
    """
    if config.network.encoder == "autodecoder":
        _check_autodecoder(config)
    holdout = min(config.holdout, len(data) // 10)
    # an autodecoder's codes are of examples, so it sees each as it is
    observed = data.further and config.network.encoder != "autodecoder"
    augment = replace(
        config.augment,
        roll=config.augment.roll and bool(data.manifest["any_roll"]),
        observations=config.augment.observations if observed else 0.0,
    )
    return replace(config, holdout=holdout, augment=augment)


def _check_autodecoder(config: TrainConfig) -> None:
    if not config.supervision.distances:
        raise ValueError(
            f"the loss is {config.loss!r}, but an autodecoder finds the code of a cloud by its distances, which only "
            "the L1 term trains; take --loss l1, ce+l1 or ce+l1+cd"
        )
    if config.augment != AugmentConfig():
        raise ValueError(
            "an autodecoder has one code per training example, and augmentation makes another example of it each "
            "time; train without, as the preset paper-autodecoder does"
        )


def start_network(config: TrainConfig, data: Dataset) -> Network:
    """Network to train: random from the seed, or with the weights that ``config.init`` names.

    Weights that know other segments give all that is not about segments (docs/learning.md). An
    autodecoder gets a random code for each example that is not held out. Raises ``ValueError`` when the weights are of
    another architecture.
    """
    names = tuple(segment["name"] for segment in data.manifest["segments"])
    torch.manual_seed(config.seed)
    network = Network(config.network, len(names))
    if config.init:
        start = load_model(config.init)
        _check_architecture(start.network.config, config)
        given = start.network.state_dict()
        if start.names != names:
            given = _without_segments(given, network)
        network.load_state_dict(network.state_dict() | given)
    if isinstance(network.encoder, Autodecoder):
        network.encoder.add_codes(len(data) - config.holdout, config.code_length)
    lookup = network.decoder.lookup
    if lookup is not None:
        lookup.distance.copy_(data.template)
    return network


def trained_model(
    average: Network,
    data: Dataset,
    config: TrainConfig,
    step: int,
    offsets: Float[Tensor, " c"] | None,
    before: int | None = 0,
) -> Model:
    """Model of the averaged network after ``step`` steps, class offsets in its last bias, with its weights' header.

    ``before`` is the number of examples that the weights it started from had seen (``seen_by``).
    """
    network = average
    if offsets is not None:
        network = copy.deepcopy(average)  # the running average must stay what it is
        with torch.no_grad():
            network.decoder.head.bias[: len(offsets)] += offsets.to(network.decoder.head.bias.device)
    manifest = data.manifest
    provenance: dict[str, object] = {
        "scene": manifest["scene"],
        "source": manifest.get("source"),
        "data": manifest["settings"],
        "training_seed": manifest["seed"],
        "training_examples": manifest["examples"],
        "steps": step,
        "examples_before": before,
        "mereo": manifest["version"],
        "visible_m": data.visible_m,
        "class_offsets": None if offsets is None else offsets.tolist(),
        "recipe": config.to_dict(),
    }
    return Model(
        network=network,
        names=tuple(s["name"] for s in manifest["segments"]),
        colors=tuple(tuple(s["color"]) for s in manifest["segments"]),
        loss=config.loss,
        provenance=provenance,
        domain=data.domain if config.learned_box else None,
        nested=tuple((inner, outer) for inner, outer in manifest.get("nested", ())),
        statistical_model=data.statistical_model,
    )


COUNTS = ("points", "neighbors", "ratio1", "ratio2", "local_neighbors", "sight_neighbors", "align_points")
"""Settings of a network that say how many points are looked at: weights trained with one number run with another."""


def _check_architecture(start: NetworkConfig, config: TrainConfig) -> None:
    """Raise ``ValueError`` where weights differ in more than an added template lookup and counts that both have."""
    given = start.to_dict()
    ours = config.network.to_dict()
    free = {name for name in COUNTS if given[name] and ours[name]}
    if ours["rest_template"]:
        free.add("rest_template")
    odd = [name for name, value in ours.items() if value != given.get(name) and name not in free]
    if odd:
        raise ValueError(
            f"the weights {config.init} have another network setting {odd[0]}; continuing needs the same "
            "network: use the preset and settings they were trained with, or train without --init"
        )


def _without_segments(given: dict[str, Tensor], network: Network) -> dict[str, Tensor]:
    """What weights of one object can tell a ``network`` of another: all but its segments and its template.

    Of the last layer, the rows of empty space, distance and direction mean the same everywhere; the others stay as
    they are in ``network``.
    """
    kept = {name: value for name, value in given.items() if not name.startswith(("decoder.lookup.", "decoder.head."))}
    for name, value in network.decoder.head.state_dict(prefix="decoder.head.").items():
        kept[name] = torch.cat([given[name][:1], value[1:-4], given[name][-4:]])
    return kept


def claim_run(run_dir: Path, config: TrainConfig, data: Dataset, process: Process) -> None:
    """Create the run directory, or check that it belongs to the same settings and dataset.

    Process 0 does so alone: another one would find the directory that it is just creating, without its settings yet.
    The others wait, and end where process 0 refuses.
    """
    if config.batch % process.world:
        raise ValueError(
            f"the batch of {config.batch} cannot be shared by {process.world} processes; it must be a multiple: "
            "change --batch or the number of processes"
        )
    with meeting(process):
        if process.is_main:
            dataset = {key: data.manifest[key] for key in ("scene", "seed", "examples")}
            settings = json.loads(json.dumps({"dataset": dataset, "train": config.to_dict()}))
            before = claim(run_dir, "config.json", settings, "a training run")
            if before is not None and before != settings:
                raise ValueError(
                    f"{run_dir} holds a run with another {_first_difference(before, settings)}; continuing needs equal "
                    "settings: use them, or another --output"
                )


def _first_difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    for group in now:
        earlier = before.get(group)
        earlier = earlier if isinstance(earlier, dict) else {}
        for key, value in now[group].items():
            if earlier.get(key) != value:
                return f"{group} setting {key} ({earlier.get(key)!r:.80} instead of {value!r})"
    return "format"


# --- examples seen ----------------------------------------------------------------------------------------------------

# A training writes how many examples its start had seen into its weights (``examples_before``), so chains add up.

_BEFORE: Mapping[tuple[str, ...], int] = {
    ("bunny", "3", "6530"): 132_320,
    ("engine", "11", "6240"): 438_448,
    ("human", "7", "4872"): 423_730,
    ("lizard", "10", "3372"): 414_766,
    ("robot", "8", "10326"): 449_668,
    ("rope", "5", "10351"): 70_980,
    ("shapes", "12", "5744"): 407_884,
    ("sheet", "9", "16860"): 433_984,
    ("skull", "6", "10326"): 441_922,
    ("tumor", "4", "4060"): 83_106,
}
"""What shipped weights had seen before their last training, by scene, seed and steps of that one.

Their files are older than ``examples_before``. The chains are in docs/experiments.md, entries 6, 13, 14, 16, 17 and 18:
all but the liver and the rope began with the bunny's 393,520, the tumour with the liver's.
"""


def seen_in_training(provenance: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """Number of examples that a training has shown, repeated ones each time, and of those that its start had seen.

    None where the weights do not say, as those of an older mereo.
    """
    recipe = provenance.get("recipe") or {}
    steps = provenance.get("steps")
    before = provenance.get("examples_before")
    if not isinstance(before, int):
        facts = (str(provenance.get(name)) for name in ("scene", "training_seed", "steps"))
        before = 0 if recipe and not recipe.get("init") else _BEFORE.get(tuple(facts))
    batch = recipe.get("batch")
    return (steps * batch if isinstance(steps, int) and isinstance(batch, int) else None), before


def seen_by(init: str) -> int | None:
    """Number of examples that weights have seen in all, by a shipped name or a file; empty are random ones.

    None where they do not say. Raises as ``load_model`` does.
    """
    latest, before = seen_in_training(load_model(init).provenance) if init else (0, 0)
    return None if latest is None or before is None else latest + before


def describe_seen(provenance: Mapping[str, Any]) -> str:
    """Words for the examples of a training and of the chain behind it; empty where the weights do not say."""
    latest, before = seen_in_training(provenance)
    if latest is None:
        return ""
    if before is None:
        return f"{latest:,} examples seen, and those of the weights that it started from, which do not say how many"
    chain = f", {latest + before:,} with those of the weights that it started from" if before else ""
    return f"{latest:,} examples seen{chain}"


# --- checkpoint -------------------------------------------------------------------------------------------------------

CHECKPOINT = "checkpoint.safetensors"


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
    write_file(run_dir / CHECKPOINT, save(tensors, metadata={"step": str(checkpoint.step)}))


def load_checkpoint(run_dir: Path, checkpoint: Checkpoint, process: Process | None = None) -> int | None:
    """Fill network, average and optimizer; returns the step, or None when there is no checkpoint yet.

    Process 0 reads the file and sends it to the others: machines that share a folder may see an older file for a while.
    """
    path = run_dir / CHECKPOINT
    content = broadcast_result(process or Process(), lambda: path.read_bytes() if path.is_file() else None)
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

    def below(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

    for prefix, module in (("network", checkpoint.network), ("average", checkpoint.average)):
        module.load_state_dict(below(f"{prefix}/"))
    states: dict[int, dict[str, Tensor]] = {}
    for name, value in below("optimizer/").items():
        index, key = name.split("/")
        states.setdefault(int(index), {})[key] = value
    # torch would take states of another network now, and fail over them at the next step
    parameters = [value for group in checkpoint.optimizer.param_groups for value in group["params"]]
    for number, state in states.items():
        shapes = {"step": torch.Size(()), "exp_avg": parameters[number].shape, "exp_avg_sq": parameters[number].shape}
        if {name: value.shape for name, value in state.items()} != shapes:
            raise ValueError(f"the optimizer's state {number} is of another network")
    groups = checkpoint.optimizer.state_dict()["param_groups"]
    checkpoint.optimizer.load_state_dict({"state": states, "param_groups": groups})
