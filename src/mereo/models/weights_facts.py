"""What a file of weights says of itself, without loading its network: for lists, and to look before one uses it."""

import json
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from mereo.io.errors import reason
from mereo.models.config import NetworkConfig, Supervision
from mereo.models.weights import PACKED
from mereo.models.weights_header import Header, read_config, read_header
from mereo.models.weights_place import STATES, find_weights
from mereo.scenes.scene import SourceFrame

NOT_LEARNT = ("running_mean", "running_var", "num_batches_tracked")
"""Tensors of batch normalization that are measured, not learnt."""


@dataclass(frozen=True)
class StatesFacts:
    """What is known of a statistical model without unpacking it.

    Attributes:
        modes: their number.
        states: random states in its library.
        vertices: of the mesh at rest.
        residue: root mean square that all modes leave of an unseen state, in scene units.
    """

    modes: int
    states: int
    vertices: int
    residue: float


@dataclass(frozen=True)
class WeightsFacts:
    """What a file of weights says of itself.

    Attributes:
        path: the file.
        version: of its format.
        header: the file's own, checked.
        network: settings of the network.
        parameters: numbers that training has learnt.
        stored_as: type of most of them, as the file has it: "F16", "F32".
        bytes: size of the file.
        states: of the statistical model; None where the weights carry none.
    """

    path: Path
    version: int
    header: Header
    network: NetworkConfig
    parameters: int
    stored_as: str
    bytes: int
    states: StatesFacts | None

    @property
    def scene(self) -> str:
        """Name of the scene that the weights know, "unknown" where they do not say."""
        return str(self.header.provenance.get("scene") or "unknown")

    @property
    def supervision(self) -> Supervision:
        """What the network can be asked."""
        return Supervision.of(self.header.loss)

    @property
    def unit_m(self) -> float | None:
        """Metres per scene unit; None where the object's true size is not known."""
        frame = SourceFrame.of_facts((self.header.states or {}).get("frame"))
        return None if frame is None else frame.unit_m

    @property
    def sha256(self) -> str:
        """Digest of the file, in hexadecimal digits."""
        return sha256(self.path.read_bytes()).hexdigest()


def read_facts(name: str | Path) -> WeightsFacts:
    """Facts about weights, by a shipped name or from a file.

    Raises ``FileNotFoundError`` for unknown names, ``ValueError`` for a file that is not weights of this version.
    """
    path = find_weights(name)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            slices = {key: file.get_slice(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
            tensors = {key: (tuple(one.get_shape()), str(one.get_dtype())) for key, one in slices.items()}
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path} is not a safetensors file ({reason(error)}); give the weights written by mereo train"
        ) from None
    header = read_header(path, metadata)
    learnt = {key: found for key, found in tensors.items() if _is_learnt(key)}
    types = [kind for _, kind in learnt.values()]
    return WeightsFacts(
        path=path,
        version=json.loads(metadata["mereo"])["version"],
        header=header,
        network=read_config(path, header),
        parameters=sum(_count(shape) for shape, _ in learnt.values()),
        stored_as=max(set(types), key=types.count) if types else "",
        bytes=path.stat().st_size,
        states=_states(tensors, header.states),
    )


def _is_learnt(key: str) -> bool:
    return not key.startswith(STATES) and key != PACKED and not key.endswith(NOT_LEARNT)


def _count(shape: tuple[int, ...]) -> int:
    product = 1
    for length in shape:
        product *= length
    return product


def _states(tensors: dict[str, tuple[tuple[int, ...], str]], facts: dict[str, Any] | None) -> StatesFacts | None:
    shapes = [tensors.get(f"{STATES}{name}", ((), ""))[0] for name in ("library", "vertices")]
    if facts is None or not all(shapes):
        return None
    (states, modes), vertices = shapes[0], shapes[1][0]
    return StatesFacts(modes, states, vertices, float(facts.get("residue", float("nan"))))
