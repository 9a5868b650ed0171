"""Trained networks as graphs for other runtimes: ONNX, and torch.export's ``.pt2``.

Two graphs, because a cloud is encoded once and queried often:

    encoder   cloud [1, n, 3]                            -> code tensors
    query     points [1, q, 3], code tensors, and with free-space evidence cloud and viewpoint [1, 3]
                                                         -> logits [1, q, c], distance [1, q], direction [1, q, 3]

All coordinates are normalized, the cloud in farthest-point order; ``mereo_onnx.py``, which goes with ONNX graphs,
does both in numpy. n and q are open: n from the network's own number of points up. See docs/architecture.md.
"""

import io
import logging
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from mereo.geometry.conventions import MIN_POINTS, Names
from mereo.io.atomic_files import new_directory, write_json
from mereo.io.errors import AnyPath
from mereo.models.config import ExportFormat
from mereo.models.decoder import Code
from mereo.models.encoders import Level
from mereo.models.model import DENSE_FACTOR, Model
from mereo.models.network import Network
from mereo.models.rigid_alignment import Alignment, svd3
from mereo.models.weights import load_model

RUNNER = Path(__file__).with_name("mereo_onnx.py")

FIXED_SIZE = ("latent1", "latent2", "rotation", "shift", "viewpoint")
"""Code tensors whose size does not depend on the number of points."""

ANSWERS = ("logits", "distance", "direction")

Open = Dim.DYNAMIC
"""A size that the graph leaves open; torch finds its bounds."""


Tensors = dict[str, Tensor]
"""Tensors by their names."""


class EncoderGraph(nn.Module):
    """Module to trace, from a cloud to code tensors by name."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, cloud: Float[Tensor, "1 n 3"]) -> Tensors:
        """Code tensors of a normalized cloud in farthest-point order."""
        unused = torch.zeros_like(cloud[:, 0])  # the viewpoint: only queries look along lines of sight
        return code_tensors(self.network.encode(cloud, unused))


class QueryGraph(nn.Module):
    """Module to trace, from points and code tensors to what ``Model.respond`` says."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model, self.network = model, model.network

    def forward(self, points: Float[Tensor, "1 q 3"], code: Tensors) -> Tensors:
        """Answers by name at normalized points."""
        answers = self.model.respond(self.network.query(code_of(code), points), points)
        return dict(zip(ANSWERS, answers, strict=True))


def code_tensors(code: Code) -> Tensors:
    """Tensors by name that the encoder has computed; the cloud and the viewpoint are known without it."""
    tensors = {"latent1": code.latent1, "latent2": code.latent2}
    for number, level in enumerate(code.levels, start=1):
        tensors |= {f"centers{number}": level.centers, f"features{number}": level.features}
    if code.alignment is not None:
        tensors |= {"rotation": code.alignment.rotation, "shift": code.alignment.shift}
    return tensors


def code_of(tensors: Tensors) -> Code:
    """Code from its tensors, the inverse of ``code_tensors``; only lines of sight need cloud and viewpoint."""
    levels = list[Level]()
    while (name := f"centers{len(levels) + 1}") in tensors:
        levels.append(Level(tensors[name], tensors[name.replace("centers", "features")]))
    alignment = Alignment(tensors["rotation"], tensors["shift"]) if "rotation" in tensors else None
    nothing = torch.zeros(1, 1, 3)
    cloud, viewpoint = tensors.get("cloud", nothing), tensors.get("viewpoint", nothing[:, 0])
    return Code(tensors["latent1"], tensors["latent2"], tuple(levels), cloud, viewpoint, alignment)


@dataclass(frozen=True, eq=False)
class Graphs:
    """Encoder and query of a network as torch programs.

    Attributes:
        encoder, query: the programs.
        inputs: names of the query's inputs after ``points``, in order.
        outputs: names of the encoder's outputs, in order.
        most: points of a cloud that the encoder takes, from the network's number of points up; None is no limit.
    """

    encoder: ExportedProgram
    query: ExportedProgram
    inputs: Names
    outputs: Names
    most: int | None


def export_graphs(model: Model) -> Graphs:
    """Traced programs of a model. Raises ``ValueError`` for an autodecoder."""
    config = model.network.config
    if config.encoder == "autodecoder":
        raise ValueError(
            "these weights are an autodecoder's, which finds the code of a cloud by gradient steps; a graph has none: "
            "train with --network.encoder pointnet2 or point-transformer to export"
        )
    cloud = _example_points(config.points)
    encoder = EncoderGraph(model.network).eval()
    query = QueryGraph(model).eval()
    with torch.no_grad(), _quiet():
        traced = torch.export.export(encoder, (cloud,), dynamic_shapes=({1: Open},), strict=False)
        code = encoder(cloud)
        outputs = tuple(code)
        if config.additions.sight_neighbors:
            code |= {"cloud": cloud, "viewpoint": torch.tensor([[0.1, -0.2, -8.0]])}
        open_sizes = {name: None if name in FIXED_SIZE else {1: Open} for name in code}
        points = _example_points(24)
        queried = torch.export.export(query, (points, code), dynamic_shapes=({1: Open}, open_sizes), strict=False)
    (bounds,) = traced.range_constraints.values()
    most = None if float(bounds.upper) > 2.0**60 else int(bounds.upper)  # torch's bound of an open size is huge
    return Graphs(traced, queried, tuple(code), outputs, most)


def _example_points(count: int) -> Float[Tensor, "1 n 3"]:
    """Points on a sphere: the values do not matter, their number does not stay."""
    points = torch.randn(1, count, 3, generator=torch.Generator().manual_seed(0))
    return nn.functional.normalize(points, dim=-1)


def write_graphs(graphs: Graphs, directory: Path, format: ExportFormat) -> None:
    """Write ``encoder`` and ``query``, as ``.onnx`` or, for ``torch.export.load``, as ``.pt2``."""
    inputs = {"encoder": ["cloud"], "query": ["points", *graphs.inputs]}
    outputs = {"encoder": graphs.outputs, "query": ANSWERS}
    for name, program in (("encoder", graphs.encoder), ("query", graphs.query)):
        if format == "torch":
            content = io.BytesIO()  # torch ends the process where it writes a file itself and the disk is full
            torch.export.save(program, content)
            (directory / f"{name}.pt2").write_bytes(content.getbuffer())
            continue
        with torch.no_grad():
            written = torch.onnx.export(
                program.run_decompositions(DECOMPOSITIONS),
                input_names=inputs[name],
                output_names=list(outputs[name]),
                dynamo=True,
                external_data=False,
                verbose=False,
            )
        assert written is not None
        written.save(directory / f"{name}.onnx")


@contextmanager
def _quiet() -> Iterator[None]:
    """Context without the warnings of torch about its own internals and packages that nobody needs here."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(action="ignore"):
        yield


def export_weights(
    weights: Model | AnyPath, output: AnyPath, format: ExportFormat = "onnx", force: bool = False
) -> None:
    """Write a new directory with both graphs, ``model.json`` and, for ONNX, the runner (``mereo export``).

    Raises ``ValueError`` for an autodecoder, ``ImportError`` without the extra `onnx`, ``FileExistsError`` for a
    directory with content unless ``force``.
    """
    for package in ("onnx", "onnxscript") if format == "onnx" else ():
        if find_spec(package) is None:
            raise ImportError(f"{package} is needed to export to ONNX: pip install 'mereo[onnx]'")
    read = [] if isinstance(weights, Model) else [weights]
    with new_directory(output, force, read) as directory:
        model = weights if isinstance(weights, Model) else load_model(weights)
        graphs = export_graphs(model)
        with _quiet():
            write_graphs(graphs, directory, format)
        facts = {
            "version": 1,
            "names": model.names if model.segmented else ["object"],
            "colors": model.colors if model.segmented else [model.colors[0]],
            "nested": model.nested,
            "loss": model.loss,
            "encoder_outputs": graphs.outputs,
            "query_inputs": graphs.inputs,
            "points": model.network.config.points,
            "most_points_of_the_graph": graphs.most,
            "fewest_points_of_a_cloud": MIN_POINTS,
            "dense_factor": DENSE_FACTOR,
            "normalizer": "center and half of the longest side of the observed cloud's box",
            "provenance": model.provenance,
        }
        write_json(directory / "model.json", facts)
        if format == "onnx":
            shutil.copyfile(RUNNER, directory / RUNNER.name)
    print(f"wrote {output}: encoder and query for clouds of {model.network.config.points} points")
    if format == "onnx":
        print(f"try: python {Path(output) / RUNNER.name} frame.npy --points queries.npy -o out.npz")


# --- operators --------------------------------------------------------------------------------------------------------

# Operators that ONNX lacks, made of those it has: the SVD of 3 x 3 matrices and 3-D sampling. They have torch's own
# arguments, and its results to rounding.


def trilinear(volume: Tensor, grid: Tensor, interpolation_mode: int, padding_mode: int, align_corners: bool) -> Tensor:
    """Trilinear ``grid_sample`` of a volume [1, c, d, h, w] at [1, i, j, k, 3] in [-1, 1]: [1, c, i, j, k].

    Only as ``decoder.RestLookup`` asks for it: linear (0), the border's value beyond it (1), corners aligned.
    """
    assert (interpolation_mode, padding_mode, align_corners) == (0, 1, True), "another sampling than the template's"
    channels, sizes = volume.shape[1], volume.shape[2:]
    # places are x, y, z, the last axis first
    axes = [_between(grid[..., 2 - axis].reshape(-1), size) for axis, size in enumerate(sizes)]
    values = volume.reshape(channels, -1)
    total = torch.zeros_like(axes[0][1])
    for corner in product((0, 1), repeat=3):
        index = torch.zeros_like(axes[0][0])
        weight = torch.ones_like(total)
        for (low, part), step, size in zip(axes, corner, sizes, strict=True):
            index = index * size + low + step
            weight = weight * (part if step else 1 - part)
        total = total + weight * values.index_select(1, index)
    return total.reshape(1, channels, *grid.shape[1:4])


def _between(place: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The lower of the two nodes around a place in [-1, 1], and how far towards the upper one it is, 0 to 1."""
    position = ((place + 1) / 2 * (size - 1)).clamp(0, size - 1)
    low = position.floor().clamp(max=size - 2)
    return low.long(), position - low


DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.linalg_svd.default: svd3,
    torch.ops.aten.grid_sampler.default: trilinear,
    torch.ops.aten.grid_sampler_3d.default: trilinear,
}
"""Replacements of torch's operators, for ``ExportedProgram.run_decompositions``."""
