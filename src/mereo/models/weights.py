"""Trained models on disk: one safetensors file whose header holds everything needed to run without the dataset."""

import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int8
from pydantic import BaseModel, Field, FiniteFloat, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mereo.geometry.conventions import Texts
from mereo.io.atomic_files import JsonObject, write_file
from mereo.io.errors import AnyPath, reason
from mereo.models.calibration import Calibration
from mereo.models.config import InferenceConfig, Loss, NetworkConfig, Supervision
from mereo.models.device import find_device, pick_precision
from mereo.models.encoders import CODES
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.trained import Trained
from mereo.models.weights_place import STATES, find_weights, read_facts
from mereo.scenes.statistical_model import StatisticalModel, pack_model, unpack_model
from mereo.workers.spread import Cluster

# --- the header -------------------------------------------------------------------------------------------------------

FORMAT_VERSION = 3
"""Version of the files."""

CURE = "the file is damaged or was changed: copy it again, or train again"

Checked = TypeVar("Checked", bound=BaseModel)

Name = Annotated[str, Field(min_length=1)]
Byte = Annotated[int, Field(ge=0, le=255)]
Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Provenance(BaseModel):
    """What programs read of a training's provenance; the rest is for people."""

    scene: str | None = None
    source: str | None = None
    steps: int | None = None
    examples_before: Annotated[int, Field(ge=0)] | None = None
    visible_m: tuple[FiniteFloat, FiniteFloat] | None = None
    data: JsonObject | None = None
    recipe: JsonObject | None = None


class Header(BaseModel):
    """Header of a file of weights; the fields mean what ``mereo.models.model.Model`` says.

    Attributes:
        network: settings as ``NetworkConfig.to_dict`` gives them.
        states: facts about the statistical model, which ``scenes.statistical_model`` reads; None without one.
    """

    network: JsonObject
    names: Annotated[tuple[Name, ...], Field(min_length=1, max_length=255)]
    colors: tuple[tuple[Byte, Byte, Byte], ...]
    loss: Loss
    provenance: JsonObject
    domain: tuple[Corner, Corner] | None
    nested: tuple[tuple[Name, Name], ...] = ()
    states: JsonObject | None = None
    calibration: Calibration | None = None


def read_header(path: Path, metadata: Mapping[str, str]) -> Header:
    """Header of a file with this metadata; ``ValueError`` names the file and what is wrong in it first."""
    if "mereo" not in metadata:
        raise ValueError(f"{path} holds tensors but no mereo header; give the weights.safetensors of a mereo run")
    try:
        content = json.loads(metadata["mereo"])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} has a header that is not JSON ({error}); {CURE}") from None
    version = content.get("version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{path} has weights format {version}; this mereo reads format {FORMAT_VERSION}: train again, or install "
            "the matching version"
        )
    header = _checked(path, Header, content)
    _checked(path, Provenance, header.provenance, "provenance")
    unknown = {name for pair in header.nested for name in pair} - set(header.names)
    if len(header.colors) != len(header.names) or len(set(header.names)) != len(header.names) or unknown:
        raise ValueError(
            f"{path} has a header whose names ({', '.join(header.names)}), {len(header.colors)} colours and nested "
            f"segments disagree; {CURE}"
        )
    biases = None if header.calibration is None else header.calibration.biases
    classes = 1 + (len(header.names) if Supervision.of(header.loss).labels else 1)
    if biases is not None and len(biases) != classes:
        raise ValueError(
            f"{path} has a calibration with {len(biases)} biases, and {classes} classes; calibrate it again with "
            "`mereo calibrate`"
        )
    return header


def _checked(path: Path, model: type[Checked], content: Any, *within: str) -> Checked:
    """Content as this model; ``ValueError`` names what is wrong in it first."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, (*within, *first["loc"])))
        raise ValueError(f"{path} has a header with a wrong {place!r} ({first['msg']}); {CURE}") from None


def check_tensors(path: Path, config: NetworkConfig, segments: int, tensors: Mapping[str, Tensor]) -> None:
    """Raise ``ValueError`` for tensors that the network does not have, or has in another shape, and for lost numbers.

    The network is only described for that, on torch's device "meta": a header may ask for one that fits no memory.
    """
    try:
        with torch.device("meta"):
            expected = {name: value.shape for name, value in Network(config, segments).state_dict().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path} has a header of no possible network ({str(error).splitlines()[0]}); {CURE}") from None
    for name in sorted(expected.keys() | tensors.keys()):
        if name not in tensors:
            raise ValueError(f"{path} lacks the tensor {name}; {CURE}")
        if name not in expected:
            raise ValueError(f"{path} has a tensor {name}, which the network of its header has not; {CURE}")
        if tensors[name].shape != expected[name]:
            raise ValueError(
                f"{path} has the tensor {name} of shape {list(tensors[name].shape)}, and its header says "
                f"{list(expected[name])}; {CURE}"
            )
        if not tensors[name].isfinite().all():
            raise ValueError(f"{path} has NaN or infinity in the tensor {name}; its training diverged: train again")


# --- the file ---------------------------------------------------------------------------------------------------------

PACKED = "decoder.lookup.distance"
"""The template's signed distances: with ten segments more than half of a float16 file."""

FINE = 0.1
"""Reach of a surface, where packed distances are finest: steps of 0.0008 at it, a fiftieth of the grid's, 0.1 at 1."""


def save_model(model: Model, path: Path, dtype: torch.dtype = torch.float32) -> None:
    """Write weights and header atomically; ``float16`` halves the file and packs the template.

    All is read as float32.

    An autodecoder's codes of training examples are left out: using a network needs their mean, and at most their axes.
    """
    write_file(path, weights_bytes(model, dtype))


def weights_bytes(model: Model, dtype: torch.dtype = torch.float32) -> bytes:
    """Content of the file that ``save_model`` writes."""
    states, facts = ({}, None) if model.statistical_model is None else pack_model(model.statistical_model)
    header = {
        "version": FORMAT_VERSION,
        "network": model.network.config.to_dict(),
        "names": model.names,
        "colors": model.colors,
        "loss": model.loss,
        "normalizer": "center and half of the longest side of the observed cloud's box",
        "domain": model.domain,
        "nested": model.nested,
        "provenance": model.provenance,
        **({} if facts is None else {"states": facts}),
        **({} if model.calibration is None else {"calibration": model.calibration.model_dump(exclude_none=True)}),
    }
    tensors = {
        name: _stored(name, value, dtype).contiguous()
        for name, value in model.network.state_dict().items()
        if name != CODES
    }
    tensors |= {STATES + name: torch.from_numpy(value) for name, value in states.items()}
    return save(tensors, metadata={"mereo": json.dumps(header)})


def with_calibration(name: AnyPath, calibration: Calibration) -> bytes:
    """Content of a file of weights with another calibration; all else in it stays, bit for bit.

    Raises as ``load_model`` does for a file that is none.
    """
    path = find_weights(name)
    tensors, metadata = _read(path)
    read_header(path, metadata)
    header = json.loads(metadata["mereo"]) | {"calibration": calibration.model_dump(exclude_none=True)}
    return save(tensors, metadata={**metadata, "mereo": json.dumps(header)})


def _read(path: Path) -> tuple[dict[str, Tensor], Texts]:
    """Tensors and metadata of a safetensors file; ``ValueError`` for another file."""
    try:
        with safe_open(path, framework="pt") as file:
            return {key: file.get_tensor(key) for key in file.keys()}, file.metadata() or {}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path} is not a safetensors file ({reason(error)}); give the weights written by mereo train"
        ) from None


def _stored(name: str, value: Tensor, dtype: torch.dtype) -> Tensor:
    """A tensor of the network as the file has it."""
    if name == PACKED and dtype == torch.float16:
        return _pack(value)
    return value.to(dtype) if value.is_floating_point() else value


def _restored(name: str, value: Tensor) -> Tensor:
    """A tensor of the file as the network has it."""
    if name == PACKED and value.dtype == torch.int8:
        return _unpack(value)
    return value.float() if value.is_floating_point() else value


def _pack(distance: Float[Tensor, "*s"]) -> Int8[Tensor, "*s"]:
    """One byte each: ``d / (|d| + FINE)`` in 254 steps, so that what is near is kept finely."""
    return (127.0 * distance / (distance.abs() + FINE)).round().to(torch.int8)


def _unpack(packed: Int8[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """Inverse of ``_pack`` up to rounding; no distance of the template is so large that it would be infinite."""
    share = packed.float() / 127.0
    return FINE * share / (1.0 - share.abs())


def trained_steps(path: Path) -> int | None:
    """Steps of training that a file of weights says it has had, from its header alone; None where it is none."""
    try:
        steps = read_facts(path)[1]["provenance"].get("steps")
    except (OSError, ValueError):
        return None
    return steps if isinstance(steps, int) else None


def load_for(name: AnyPath, inference: InferenceConfig) -> Model:
    """Trained model (``load_model``) on the device and in the precision that are asked for."""
    return replace(load_model(name, find_device(inference.device)), precision=inference.precision)


def load_model(name: AnyPath, device: torch.device | str = "cpu") -> Model:
    """Trained model, a shipped one by its name or one from a file.

    Raises ``FileNotFoundError`` for unknown names, ``ValueError`` when it is not weights of this version.
    """
    path = find_weights(name)
    tensors, metadata = _read(path)
    header = read_header(path, metadata)
    states = {key.removeprefix(STATES): tensors.pop(key).numpy() for key in list(tensors) if key.startswith(STATES)}
    try:
        config = NetworkConfig.from_dict(header.network)
    except ValueError as error:
        raise ValueError(f"{path} has a header of no possible network ({error}); {CURE}") from None
    restored = {name: _restored(name, value) for name, value in tensors.items()}
    check_tensors(path, config, len(header.names), restored)
    network = Network(config, len(header.names))
    network.load_state_dict(restored)
    return Model(
        network=network.eval().requires_grad_(False).to(device),
        names=header.names,
        colors=header.colors,
        loss=header.loss,
        provenance=header.provenance,
        domain=header.domain,
        nested=header.nested,
        statistical_model=_unpacked(path, states, header) if states else None,
        calibration=header.calibration,
        name=str(name),
    )


def _unpacked(path: Path, states: dict[str, np.ndarray], header: Header) -> StatisticalModel:
    """Statistical model of a file; whatever does not fit in it is one sentence."""
    try:
        if lost := [name for name, value in states.items() if not np.isfinite(value).all()]:
            raise ValueError(f"there is NaN or infinity in {STATES}{lost[0]}")
        return unpack_model(states, header.states or {})
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        kind = "nothing is called " if isinstance(error, KeyError) else ""
        raise ValueError(
            f"{path} has a statistical model that cannot be read ({kind}{reason(error)}); {CURE}"
        ) from None


# --- in tasks of a cluster --------------------------------------------------------------------------------------------

# A model is loaded on the CPU, sent, and moved to the device that a task has.


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
