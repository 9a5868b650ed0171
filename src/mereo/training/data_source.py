"""Whether a training holds its examples in memory or streams them, and the dataset either way."""

import json
import os
from dataclasses import replace
from pathlib import Path

import torch

from mereo.io.free_memory import free_bytes
from mereo.io.object_storage import Place
from mereo.synthesis.dataset_contents import dataset_key, list_shards, read_manifest, recorded_files
from mereo.training.config import DataPlace, TrainConfig
from mereo.training.dataset import Dataset, read_part
from mereo.training.processes import Process, told
from mereo.training.streaming import StreamingDataset

TrainingData = Dataset | StreamingDataset
"""Examples, as training asks for them."""

SHARE = 0.5
"""Of the free memory, which examples may take unless they are asked for in memory."""

SETTINGS = "config.json"


def open_data(
    directory: Place, run_dir: Path, config: TrainConfig, device: torch.device, process: Process
) -> tuple[TrainConfig, TrainingData]:
    """Recipe with the place of its examples decided, and the dataset; one that streams is yet to be surveyed.

    Raises as ``Dataset.load``.
    """
    place = told(process, lambda: choose_place(directory, run_dir, config.data, device))
    config = replace(config, data=place)
    data = StreamingDataset.open(directory, device) if place == "stream" else Dataset.load(directory, device)
    return config, data


def choose_place(directory: Place, run_dir: Path, wish: DataPlace, device: torch.device) -> DataPlace:
    """Place of the examples of a training: as wished, as a run that is continued has it, or by the free memory.

    Raises as ``Dataset.load`` for a directory that holds no dataset.
    """
    if wish != "auto":
        return wish
    before = _begun_with(run_dir)
    if before is not None:
        return before
    there = free_bytes()
    if there is not None:
        there //= int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # each process of a machine holds them
    if device.type == "cuda":
        there = min(torch.cuda.mem_get_info(device)[0], there or torch.cuda.mem_get_info(device)[0])
    needed = needed_bytes(directory)
    if there is None or needed <= SHARE * there:
        return "memory"
    print(
        f"{needed / 1e9:,.1f} GB of examples are streamed: {there / 1e9:,.1f} GB of memory are free (--data memory "
        "holds them all)",
        flush=True,
    )
    return "stream"


def needed_bytes(directory: Place) -> int:
    """Memory that all examples of a dataset take, by its first shard; 0 where it has none."""
    manifest = read_manifest(directory)
    shards = list_shards(directory)
    if not shards:
        return 0
    recorded = recorded_files(manifest).get(shards[0].name)
    first = read_part(shards[0], dataset_key(manifest), manifest.get("shard_size"), recorded)
    each = sum(tensor.nbytes for tensor in first.values()) / max(1, len(first["cloud"]))
    return int(each * manifest["examples"])


def _begun_with(run_dir: Path) -> DataPlace | None:
    """Place with which the run in a directory has begun; None where there is none that can be read."""
    try:
        settings = json.loads((run_dir / SETTINGS).read_text("utf-8"))
        return "stream" if settings["train"].get("data") == "stream" else "memory"
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None  # what is there instead is said where the directory is claimed
