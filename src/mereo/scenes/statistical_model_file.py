"""Statistical models as tensors, small enough to travel with datasets and weights.

Modes and the library of states are bytes: each mode in 254 steps of its largest motion, the first few, which move most,
in 65,534, and each coefficient in steps of a 32nd of a standard deviation. A hundred modes of 6,000 material points are
2 MB, and rounding moves points by about a hundredth of a scene unit, a tenth of the paper's noise. Rest pose and mean
keep float32.

Notation: v vertices, m material points, k modes, n states, q pairs.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.checked_tensors import Tensors, held_against, pack_tensors, read_content, unpack_tensors
from mereo.io.errors import reason
from mereo.io.object_storage import Place
from mereo.io.places import write_whole
from mereo.scenes.source_frame import SourceFrame
from mereo.scenes.statistical_model import PairDistances, StatisticalModel

LIBRARY_STEP = 1 / 32
"""Step of a coefficient; bytes reach to 4 standard deviations, which one normal number in 16,000 exceeds."""

WIDE_MODES = 12
"""The first ones, in two bytes: they move most, and so would be rounded most."""


def pack_model(model: StatisticalModel) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors of a statistical model, and the facts about it that are none: names, colours, sizes, residue."""
    wide, wide_scale = _integers(model.modes[..., :WIDE_MODES], np.int16)
    narrow, narrow_scale = _integers(model.modes[..., WIDE_MODES:], np.int8)
    library = np.clip(np.rint(model.library / LIBRARY_STEP), -127, 127).astype(np.int8)
    vertices, faces, _ = model.rest.merged()
    tensors = {
        "vertices": vertices.astype(np.float32),
        "faces": _narrow(faces),
        "nodes": model.nodes.astype(np.float32),
        "node_labels": model.node_labels,
        "mean": model.mean.astype(np.float32),
        "wide_modes": wide,
        "modes": narrow,
        "mode_scale": np.concatenate([wide_scale, narrow_scale]),
        "library": library,
        "pair_index": _narrow(np.stack([model.pairs.first, model.pairs.second])),
        "pair_distance": np.stack([model.pairs.mean, model.pairs.std]).astype(np.float32),
    }
    segments = model.rest.segments
    facts = {
        "names": list(model.rest.names),
        "colors": [list(color) for color in model.rest.colors],
        "nested": [list(pair) for pair in model.rest.nested],
        "solid": [segment.solid for segment in segments],
        "vertices": [len(segment.vertices) for segment in segments],
        "faces": [len(segment.faces) for segment in segments],
        "residue": model.residue,
        "frame": None if model.source_frame is None else model.source_frame.facts(),
    }
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}, facts


def unpack_model(tensors: Tensors, facts: Mapping[str, Any]) -> StatisticalModel:
    """Inverse of ``pack_model`` up to rounding."""
    index, (mean, std) = tensors["pair_index"].astype(np.int64), tensors["pair_distance"].astype(np.float64)
    steps = np.concatenate([tensors["wide_modes"], tensors["modes"]], axis=2, dtype=np.float32)
    return StatisticalModel(
        rest=_rest(tensors, facts),
        nodes=tensors["nodes"].astype(np.float64),
        node_labels=tensors["node_labels"],
        mean=tensors["mean"].astype(np.float64),
        modes=steps * tensors["mode_scale"],
        library=tensors["library"].astype(np.float32) * np.float32(LIBRARY_STEP),
        residue=float(facts["residue"]),
        pairs=PairDistances(index[0], index[1], mean, std),
        source_frame=SourceFrame.of_facts(facts.get("frame")),  # older files have none
    )


def save_statistical_model(model: StatisticalModel, path: Path, dataset: str | None = None) -> None:
    """Write a statistical model as one safetensors file, whole or not at all; ``dataset`` is the key of its dataset."""
    write_whole(path, statistical_model_bytes(model, dataset))


def statistical_model_bytes(model: StatisticalModel, dataset: str | None = None) -> bytes:
    """Content of the file of a statistical model."""
    tensors, facts = pack_model(model)
    return pack_tensors(tensors, {**facts, "dataset": dataset})


def load_statistical_model(path: Place, dataset: str | None = None, recorded: str | None = None) -> StatisticalModel:
    """Read what ``save_statistical_model`` wrote; ``ValueError`` for another file, or one of another dataset.

    ``recorded`` is its SHA-256 in the dataset's manifest. Raises ``StorageError`` where nothing is known of the file.
    """
    try:
        return read_statistical_model(read_content(path, recorded), dataset, recorded)
    except (FileNotFoundError, ValueError) as error:
        raise ValueError(
            f"{path} is no statistical model of mereo ({error}); delete it and run `mereo generate ... --resume`"
        ) from None


def read_statistical_model(content: bytes, dataset: str | None, recorded: str | None) -> StatisticalModel:
    """Statistical model that a file's content holds; ``ValueError`` (its reason only) where it holds none."""
    with held_against(content, recorded) as verified:
        tensors, facts = unpack_tensors(content, dataset, verified)
        try:
            return unpack_model(tensors, facts)
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(reason(error)) from None


def with_fewer_modes(model: StatisticalModel, most: int) -> StatisticalModel:
    """The model with its ``most`` largest modes; what the others move counts as residue."""
    if most >= model.count:
        return model
    lost = float((model.motion[most:] ** 2).sum())
    return replace(
        model,
        modes=np.ascontiguousarray(model.modes[..., :most]),
        library=np.ascontiguousarray(model.library[:, :most]),
        residue=float(np.sqrt(model.residue**2 + lost)),
    )


def modes_within(model: StatisticalModel, size: int) -> int:
    """Number of modes that fit into ``size`` bytes; 0 where not even the rest of the model does."""
    tensors, _ = pack_model(model)
    each = 3 * len(model.mean) + len(model.library) + 4
    fixed = sum(value.nbytes for value in tensors.values()) - each * model.count
    return min(model.count, max(0, (size - fixed) // each))


def _integers(
    modes: Float32[np.ndarray, "m 3 k"], dtype: type[np.signedinteger]
) -> tuple[Int[np.ndarray, "m 3 k"], Float32[np.ndarray, " k"]]:
    """Modes in steps of their largest motion, and the motion that one step of each stands for."""
    largest = np.abs(modes).max(axis=(0, 1), initial=1e-12)
    scale = (largest / np.iinfo(dtype).max).astype(np.float32)
    return np.rint(modes / scale).astype(dtype), scale


def _narrow(index: np.ndarray) -> np.ndarray:
    """Indices in two bytes where they fit."""
    return index.astype(np.uint16 if index.size == 0 or index.max() < 2**16 else np.uint32)


def _rest(tensors: Tensors, facts: Mapping[str, Any]) -> SegmentedMesh:
    """The segments at rest."""
    vertices, faces = tensors["vertices"].astype(np.float64), tensors["faces"].astype(np.int64)
    first, start, segments = 0, 0, []
    for name, color, solid, points, triangles in zip(
        *(facts[key] for key in ("names", "colors", "solid", "vertices", "faces")), strict=True
    ):
        own = faces[start : start + triangles] - first
        segments.append(Segment(name, tuple(color), vertices[first : first + points], own, solid))
        first, start = first + points, start + triangles
    return SegmentedMesh(tuple(segments), tuple((inner, outer) for inner, outer in facts["nested"]))
