"""Tensors in safetensors files with a checksum: what the disk or a copy has changed is noticed, and whose it is.

The header's entry ``mereo`` is JSON: facts about the tensors, and under ``sha256`` the digest of facts and tensors.
Files of earlier versions have none and are taken as they are.
"""

import hashlib
import json
from collections.abc import Mapping

import numpy as np
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mereo.geometry.conventions import Facts
from mereo.io.atomic_files import JsonObject
from mereo.io.errors import reason
from mereo.io.object_storage import Place, StorageError

HEADER, CHECKSUM = "mereo", "sha256"

Tensors = Mapping[str, ndarray]


def pack_tensors(tensors: Tensors, facts: Facts) -> bytes:
    """Content of a file with these tensors, and facts that JSON knows."""
    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    return save(whole, metadata={HEADER: json.dumps({**facts, CHECKSUM: _digest(whole, facts)})})


def read_content(path: Place) -> bytes:
    """Bytes of a file of a dataset; ``ValueError`` (its reason only) where a disk cannot read it."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path} does not exist; it is part of a dataset: check the path") from None
    except StorageError:  # a storage's silence says nothing about the file
        raise
    except OSError as error:
        raise ValueError(reason(error)) from None


def unpack_tensors(content: bytes, dataset: str | None = None) -> tuple[dict[str, ndarray], JsonObject]:
    """Tensors that ``pack_tensors`` has packed, and their facts, none where there is no header entry.

    Raises ``ValueError`` (its reason only) where the content is damaged, or of another dataset than the one of this
    key.
    """
    try:
        tensors = load(content)
        # 8 bytes with the length of a JSON object, which follows
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        facts: JsonObject = json.loads(header.get("__metadata__", {}).get(HEADER, "{}"))
        expected = facts.pop(CHECKSUM, None)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
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
        shape = tensors[name].shape
        wanted = axes.split()
        if len(shape) != len(wanted) or any(
            length != (int(axis) if axis.isdecimal() else known.setdefault(axis, length))
            for length, axis in zip(shape, wanted, strict=True)
        ):
            raise ValueError(f"its tensor {name!r} has the shape {list(shape)}")


def _digest(tensors: Tensors, facts: Facts) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype.str} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
