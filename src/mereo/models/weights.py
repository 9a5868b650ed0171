"""Trained models on disk: one safetensors file whose header holds everything needed to run without the dataset."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mereo.io.atomic_files import atomic_file
from mereo.io.errors import reason
from mereo.models.calibration import Calibration
from mereo.models.config import InferenceConfig
from mereo.models.device import find_device
from mereo.models.encoders.encoding import CODES
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights_header import CURE, FORMAT_VERSION, Header, check_tensors, read_config, read_header
from mereo.models.weights_place import STATES, find_weights
from mereo.scenes.statistical_model import StatisticalModel, pack_model, unpack_model

PACKED = "decoder.lookup.distance"
"""The template's signed distances: with ten segments more than half of a float16 file."""

FINE = 0.1
"""Reach of a surface, where packed distances are finest: steps of 0.0008 at it, a fiftieth of the grid's, 0.1 at 1."""


def save_model(model: Model, path: Path, dtype: torch.dtype = torch.float32) -> None:
    """Write weights and header atomically; ``float16`` halves the file and packs the template.

    All is read as float32.

    An autodecoder's codes of training examples are left out: using a network needs their mean, and at most their axes.
    """
    with atomic_file(path) as partial:
        partial.write_bytes(weights_bytes(model, dtype))


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


def with_calibration(name: str | Path, calibration: Calibration) -> bytes:
    """Content of a file of weights with another calibration; all else in it stays, bit for bit.

    Raises as ``load_model`` does for a file that is none.
    """
    path = find_weights(name)
    tensors, metadata = _read(path)
    read_header(path, metadata)
    header = json.loads(metadata["mereo"]) | {"calibration": calibration.model_dump(exclude_none=True)}
    return save(tensors, metadata={**metadata, "mereo": json.dumps(header)})


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
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
        with safe_open(path, framework="pt") as file:
            steps = json.loads((file.metadata() or {})["mereo"])["provenance"]["steps"]
    except (SafetensorError, OSError, KeyError, ValueError, TypeError):
        return None
    return steps if isinstance(steps, int) else None


def load_for(name: str | Path, inference: InferenceConfig) -> Model:
    """Trained model (``load_model``) on the device and in the precision that are asked for."""
    return replace(load_model(name, find_device(inference.device)), precision=inference.precision)


def load_model(name: str | Path, device: torch.device | str = "cpu") -> Model:
    """Trained model, a shipped one by its name or one from a file.

    Raises ``FileNotFoundError`` for unknown names, ``ValueError`` when it is not weights of this version.
    """
    path = find_weights(name)
    tensors, metadata = _read(path)
    header = read_header(path, metadata)
    states = {key.removeprefix(STATES): tensors.pop(key).numpy() for key in list(tensors) if key.startswith(STATES)}
    config = read_config(path, header)
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
