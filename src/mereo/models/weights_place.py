"""Where weights are, and what is read of them without torch; ``models.weights`` loads them."""

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from mereo.io.errors import reason
from mereo.scenes.statistical_model import StatisticalModel, unpack_model

SHIPPED = Path(__file__).parents[1] / "weights"

STATES = "states."
"""Beginning of the names of a statistical model's tensors."""

WEIGHTS = "weights.safetensors"
"""File of weights in a folder of `mereo train` or `mereo learn`."""


def shipped_names() -> tuple[str, ...]:
    """Names that ``load_model`` knows without a path."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.safetensors")))


def find_weights(name: str | Path) -> Path:
    """Path of weights that are given by a shipped name, as an existing file, or as the folder that holds them."""
    path = Path(name)
    shipped = SHIPPED / f"{name}.safetensors"
    if path.suffix == "" and not path.is_file() and shipped.is_file():
        return shipped
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    if not path.is_file():
        raise FileNotFoundError(
            f"there are no weights {str(name)!r}; give a .safetensors file from mereo train or one of the shipped "
            f"names: {', '.join(shipped_names()) or 'none'}"
        )
    return path


def read_facts(name: str | Path) -> tuple[Path, dict[str, Any]]:
    """Path of weights, and what their header says, read without torch and without their network.

    Raises ``FileNotFoundError`` as ``find_weights`` does, and ``ValueError`` for a file that is not weights.
    """
    path = find_weights(name)
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("mereo", "null"))
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is not a safetensors file of weights ({reason(error)}); give the weights written by mereo train"
        ) from None
    kinds = {"names": list, "network": dict, "provenance": dict}
    if not isinstance(header, dict) or not all(isinstance(header.get(key), kind) for key, kind in kinds.items()):
        raise ValueError(f"{path} holds tensors but no mereo header; give the weights.safetensors of a mereo run")
    return path, header


def is_weights(name: str | Path) -> bool:
    """Whether a name is that of weights: a shipped one, a .safetensors file, or a folder that holds one."""
    try:
        return find_weights(name).suffix == ".safetensors"
    except FileNotFoundError:
        return Path(name).suffix == ".safetensors"  # a missing file is reported where it is loaded


def statistical_model_in(name: str | Path) -> StatisticalModel:
    """Statistical model that weights carry, read without their network; ``ValueError`` where they carry none."""
    with safe_open(find_weights(name), framework="numpy") as file:
        tensors = {key.removeprefix(STATES): file.get_tensor(key) for key in file.keys() if key.startswith(STATES)}  # noqa: SIM118 (no mapping)
        header = json.loads((file.metadata() or {})["mereo"])
    if not tensors:
        raise ValueError(f"the weights {str(name)!r} carry no statistical model: take newer ones")
    return unpack_model(tensors, header["states"])
