"""Tensors in safetensors files with a checksum: what the disk or a copy has changed is noticed, and whose it is.

The header's entry ``mereo`` is JSON: facts about the tensors, and under ``sha256`` the digest of facts and tensors.
Files of earlier versions have none and are taken as they are.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from mereo.io.errors import reason

HEADER, CHECKSUM = "mereo", "sha256"

Tensors = Mapping[str, np.ndarray]


def pack_tensors(tensors: Tensors, facts: Mapping[str, Any]) -> bytes:
    """Content of a file with these tensors, and facts that JSON knows."""
    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    return save(whole, metadata={HEADER: json.dumps({**facts, CHECKSUM: _digest(whole, facts)})})


def read_tensors(path: Path, dataset: str | None = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors of a file, and its facts, none where it has no header entry.

    Raises ``FileNotFoundError``, and ``ValueError`` (its reason only) where the file is damaged, or states another
    dataset than the one of this key.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; it is part of a dataset: check the path")
    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {}).get(HEADER, "{}"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        expected = facts.pop(CHECKSUM, None)
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(reason(error)) from None
    if expected is not None and expected != _digest(tensors, facts):
        raise ValueError("its checksum is another: its bytes have changed")
    if dataset is not None and facts.get("dataset") not in (None, dataset):
        raise ValueError("it is of another dataset")
    return tensors, facts


def check_tensors(tensors: Tensors, shapes: Mapping[str, str], sizes: Mapping[str, int]) -> None:
    """Raise ``ValueError`` (its reason only) where a tensor is missing, of another shape or of complex numbers.

    Args:
        tensors: what a file holds.
        shapes: axes of each tensor, such as ``"e p 3"``; a letter stands for the same length everywhere.
        sizes: lengths of letters, where they are known.
    """
    known = dict(sizes)
    for name, axes in shapes.items():
        if name not in tensors:
            raise ValueError(f"it has no tensor {name!r}")
        if np.iscomplexobj(tensors[name]):
            raise ValueError(f"its tensor {name!r} has complex numbers")
        found, wanted = tensors[name].shape, axes.split()
        if len(found) != len(wanted) or any(
            length != (int(axis) if axis.isdecimal() else known.setdefault(axis, length))
            for length, axis in zip(found, wanted, strict=True)
        ):
            raise ValueError(f"its tensor {name!r} has the shape {list(found)}")


def _digest(tensors: Tensors, facts: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype.str} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
