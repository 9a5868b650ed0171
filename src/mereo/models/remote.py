"""A model in tasks of a cluster: loaded on the CPU, sent, and moved to the device that a task has."""

from copy import deepcopy
from dataclasses import replace

import torch

from mereo.models.config import InferenceConfig
from mereo.models.device import find_device, pick_precision
from mereo.models.model import Model
from mereo.models.trained import Trained
from mereo.workers.spread import Cluster


def settings_for(inference: InferenceConfig, workers: int | Cluster | None) -> InferenceConfig:
    """Settings to load weights with: on the CPU where tasks of a cluster compute.

    Raises ``ValueError`` where another device is asked for than tasks have.
    """
    if not isinstance(workers, Cluster):
        return inference
    if inference.device not in ("auto", workers.device):
        raise ValueError(
            f"--device is {inference.device}, but tasks of the cluster compute on {workers.device}: leave it out, or "
            "change --gpus-per-task"
        )
    return replace(inference, device="cpu")


def to_cpu(model: Trained, cluster: Cluster) -> Model:
    """The same model on the CPU, its precision chosen here once for the device of the cluster's tasks."""
    assert isinstance(model, Model)
    half = pick_precision(model.precision, torch.device(cluster.device)) is not None
    network = model.network if model.device.type == "cpu" else deepcopy(model.network).to("cpu")
    return replace(model, network=network, precision="bfloat16" if half else "float32")


def to_gpu(model: Trained) -> Model:
    """The model on this machine's GPU; raises ``ValueError`` where torch sees none."""
    assert isinstance(model, Model)
    return replace(model, network=model.network.to(find_device("cuda")))
