"""Where weights are, and what is read of them without torch; ``models.weights`` loads them."""

import json
from importlib.util import find_spec
from pathlib import Path

from safetensors import SafetensorError, safe_open

from mereo.geometry.conventions import Names
from mereo.io.atomic_files import JsonObject
from mereo.io.checked_tensors import unpack_tensors
from mereo.io.errors import AnyPath, reason
from mereo.scenes.statistical_model import StatisticalModel, unpack_model

NOT_SHIPPED = (
    "install the shipped ones, the package mereo-weights: pip install 'mereo[network]', in a checkout pip install "
    "./weights"
)
"""Cure where no weights are shipped."""

STATES = "states."
"""Beginning of the names of a statistical model's tensors."""

WEIGHTS = "weights.safetensors"
"""File of weights in a folder of `mereo train` or `mereo learn`."""


def shipped_weights() -> dict[str, Path]:
    """Files of the shipped weights by their names; none where their package is not installed."""
    places = getattr(find_spec("mereo_weights"), "submodule_search_locations", ())
    return {path.stem: path for place in places for path in sorted(Path(place).glob("*.safetensors"))}


def shipped_names() -> Names:
    """Names that ``load_model`` knows without a path."""
    return tuple(shipped_weights())


def has_network() -> bool:
    """Whether the extra `network` is installed: torch, and the shipped weights."""
    return find_spec("torch") is not None and bool(shipped_weights())


def find_weights(name: AnyPath) -> Path:
    """Path of weights that are given by a shipped name, as an existing file, or as the folder that holds them."""
    path = Path(name)
    shipped = shipped_weights()
    if str(name) in shipped and not path.is_file():
        return shipped[str(name)]
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    if not path.is_file():
        raise FileNotFoundError(
            f"there are no weights {str(name)!r}; give a .safetensors file from mereo train or "
            f"{'one of the shipped names: ' + ', '.join(shipped) if shipped else NOT_SHIPPED}"
        )
    return path


def read_facts(name: AnyPath) -> tuple[Path, JsonObject]:
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


def is_weights(name: AnyPath) -> bool:
    """Whether a name is that of weights: a shipped one, a .safetensors file, or a folder that holds one.

    That of the bunny is one also where the shipped weights are not installed, as their statistical model is there.
    """
    try:
        return _find_states(name).suffix == ".safetensors"
    except FileNotFoundError:
        return Path(name).suffix == ".safetensors"  # a missing file is reported where it is loaded


def statistical_model_in(name: str) -> StatisticalModel:
    """Statistical model that shipped weights carry, read without their network; the bunny's where none are installed.

    Raises ``FileNotFoundError`` as ``find_weights`` does.
    """
    tensors, header = unpack_tensors(_find_states(name).read_bytes())
    states = {key.removeprefix(STATES): value for key, value in tensors.items() if key.startswith(STATES)}
    return unpack_model(states, header["states"])


def _find_states(name: AnyPath) -> Path:
    """Path of weights, or of what ``mereo/states`` has of some that are not installed, which is all but the network."""
    try:
        return find_weights(name)
    except FileNotFoundError:
        kept = Path(__file__).parents[1] / "states" / f"{name}.safetensors"
        if not kept.is_file():
            raise
        return kept
