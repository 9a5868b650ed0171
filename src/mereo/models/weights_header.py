"""Header of a file of weights, checked: what is missing, of another type or in disagreement is said in one sentence."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from pydantic import BaseModel, Field, FiniteFloat, ValidationError
from torch import Tensor

from mereo.models.calibration import Calibration
from mereo.models.config import Loss, NetworkConfig, Supervision
from mereo.models.network import Network

FORMAT_VERSION = 3
"""Version of the files."""

CURE = "the file is damaged or was changed: take it anew, or train again"

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
    data: dict[str, Any] | None = None
    recipe: dict[str, Any] | None = None


class Header(BaseModel):
    """Header of a file of weights; the fields mean what ``mereo.models.model.Model`` says.

    Attributes:
        network: settings as ``NetworkConfig.to_dict`` gives them.
        states: facts about the statistical model, which ``scenes.statistical_model`` reads; None without one.
    """

    network: dict[str, Any]
    names: Annotated[tuple[Name, ...], Field(min_length=1, max_length=255)]
    colors: tuple[tuple[Byte, Byte, Byte], ...]
    loss: Loss
    provenance: dict[str, Any]
    domain: tuple[Corner, Corner] | None
    nested: tuple[tuple[Name, Name], ...] = ()
    states: dict[str, Any] | None = None
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
    strangers = {name for pair in header.nested for name in pair} - set(header.names)
    if len(header.colors) != len(header.names) or len(set(header.names)) != len(header.names) or strangers:
        raise ValueError(
            f"{path} has a header whose names ({', '.join(header.names)}), {len(header.colors)} colours and nested "
            f"segments disagree; {CURE}"
        )
    _check_biases(path, header)
    return header


def _check_biases(path: Path, header: Header) -> None:
    """Raise ``ValueError`` for a calibration of other classes than the network tells apart."""
    biases = None if header.calibration is None else header.calibration.biases
    classes = 1 + (len(header.names) if Supervision.of(header.loss).labels else 1)
    if biases is not None and len(biases) != classes:
        raise ValueError(
            f"{path} has a calibration with {len(biases)} biases, and {classes} classes; calibrate it again with "
            "`mereo calibrate`"
        )


def _checked(path: Path, model: type[Checked], content: Any, *within: str) -> Checked:
    """Content as this model; ``ValueError`` names what is wrong in it first."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, (*within, *first["loc"])))
        raise ValueError(f"{path} has a header with a wrong {place!r} ({first['msg']}); {CURE}") from None


def read_config(path: Path, header: Header) -> NetworkConfig:
    """Settings of the network; ``ValueError`` names the file and the setting that is unknown or out of its bounds."""
    try:
        return NetworkConfig.from_dict(header.network)
    except ValueError as error:
        raise ValueError(f"{path} has a header of no possible network ({error}); {CURE}") from None


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
