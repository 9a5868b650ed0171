"""A model that computes elsewhere: in tasks of a cluster, each of which has GPUs of its own, or none.

settings -for_tasks-> those to load with here; Model -sent-> what a task is given -arrived-> on the task's device
"""

from copy import deepcopy
from dataclasses import replace

import torch

from mereo.models.config import InferenceConfig
from mereo.models.device import find_device
from mereo.models.model import Model
from mereo.models.trained import Trained
from mereo.workers.config import Cluster


def for_tasks(inference: InferenceConfig, cluster: Cluster | None) -> InferenceConfig:
    """Settings to load weights with that are asked in tasks: on the CPU, from where they go to each task's device.

    Raises ``ValueError`` where the device that is asked for is not what tasks have.
    """
    if cluster is None:
        return inference
    if inference.device == "cuda" and not cluster.gpus:
        raise ValueError("--device is cuda, but tasks have no GPU: give each one, or a share, with --gpus-per-task 1")
    if inference.device == "cpu" and cluster.gpus:
        raise ValueError("--device is cpu, but tasks have GPUs, which would be idle: leave out --gpus-per-task")
    return replace(inference, device="cpu")


def sent(model: Trained, cluster: Cluster) -> Model:
    """The same model on the CPU, with a precision that does not depend on which machine asks."""
    assert isinstance(model, Model)
    precision = model.precision
    if precision == "auto":
        precision = "bfloat16" if cluster.gpus or model.working_dtype == torch.bfloat16 else "float32"
    network = model.network if model.device.type == "cpu" else deepcopy(model.network).to("cpu")
    return replace(model, network=network, precision=precision)


def arrived(model: Trained, gpu: bool) -> Model:
    """The model on the GPU of this task; itself where tasks have none.

    Raises ``ValueError`` where torch sees no GPU here.
    """
    assert isinstance(model, Model)
    return replace(model, network=model.network.to(find_device("cuda"))) if gpu else model
