"""Answers to the depth images of one camera with shapes that never change, so that a GPU runs them as CUDA graphs.

Launching the network's few hundred kernels one by one takes longer than running them. With fixed shapes the launches
are recorded once and replayed: an image goes up, the labels come down, and nothing in between waits for the host. On a
CPU the same steps run one by one, which is how they are tested.

Notation: h x w pixels, n = h w, q queries.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from mereo.geometry.camera import Camera
from mereo.geometry.farthest_point_sampling import farthest_point_order
from mereo.models.config import MOST_ORDERED
from mereo.models.decoder import Code
from mereo.models.model import Model
from mereo.models.ops.neighbors import gpu_kernels
from mereo.models.trained import check_enough

SIZES = (4096, 10_000, 40_000)
"""Numbers of queries at once; what is asked is padded to the next of them."""

WARM_UPS = 3
"""Number of runs before recording, as PyTorch asks for: libraries set themselves up in the first ones."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Seen:
    """Encoded depth image, ready to be queried.

    Attributes:
        code: the network's side.
        center, scale: to normalized coordinates, ``(point - center) * scale``.
        count: of measured pixels.
    """

    code: Code
    center: Float[Tensor, "3"]
    scale: Float[Tensor, ""]
    count: Int[Tensor, ""]


class StaticFrames:
    """Answers of a model to the depth images of one camera, as CUDA graphs on a GPU.

    Args:
        model: any but an autodecoder, whose search needs gradients.
        camera: of all images, at most ``MOST_ORDERED`` pixels: crop a larger one around the object.
        sizes: numbers of queries that are prepared.

    Raises ``ValueError`` for other models and cameras, ``ImportError`` on CUDA without Triton.
    """

    def __init__(self, model: Model, camera: Camera, sizes: tuple[int, ...] = SIZES) -> None:
        pixels = camera.width * camera.height
        if pixels > MOST_ORDERED:
            raise ValueError(
                f"the image has {camera.width} x {camera.height} pixels; at most {MOST_ORDERED} fit into one program: "
                "crop it around the object, or use Model.encode"
            )
        if not sizes or min(sizes) < 1:
            raise ValueError(
                f"the sizes are {sizes}; at least one number of queries must be prepared: give for example 4096"
            )
        if model.network.config.encoder == "autodecoder":
            raise ValueError("an autodecoder searches for its code, which has no fixed shape: use Model.encode")
        if model.device.type == "cuda" and gpu_kernels() is None:
            raise ImportError("fixed frames on CUDA need triton, which PyTorch's builds for Linux bring: install it")
        self.model, self.camera, self.sizes = model, camera, tuple(sorted(sizes))
        self._rays = torch.from_numpy(camera.directions().reshape(-1, 3).astype(np.float32)).to(model.device)
        self._depth = _Buffer((pixels,), model.device)
        self._points = {size: _Buffer((size, 3), model.device) for size in self.sizes}
        self._steps: dict[int, Callable[[], tuple[Tensor, Tensor]]] = {}
        self._see: Callable[[], Seen] | None = None
        self._seen: Seen | None = None

    def see(self, depth: Float[np.ndarray, "h w"]) -> None:
        """Take the next image: depth in any unit, 0 where nothing was measured; does not wait for the device."""
        expected = (self.camera.height, self.camera.width)
        if depth.shape != expected:
            raise ValueError(f"the image is {depth.shape}; the camera's are {expected} (rows, columns): use its camera")
        self._depth.put(depth.reshape(-1))
        if self._see is None:
            self._see = self._prepared(lambda: self._observe(self._depth.on_device))
        self._seen = self._see()

    def ask(self, points: Float[np.ndarray, "q 3"]) -> tuple[UInt8[np.ndarray, " q"], Float32[np.ndarray, " q"]]:
        """Label and signed distance at each point, camera frame, the images' unit; waits for the device.

        Raises ``ValueError`` before the first image and where the object has too few pixels.
        """
        if self._seen is None:
            raise ValueError("there is no image to ask about: call see first")
        labels, distances = [], []
        largest = self.sizes[-1]
        for start in range(0, max(len(points), 1), largest):
            part = points[start : start + largest]
            found = self._ask(part, next(size for size in self.sizes if size >= len(part)))
            labels.append(found[0])
            distances.append(found[1])
        count = int(self._seen.count)
        check_enough(count, f"the object has {count} pixels")
        return np.concatenate(labels), np.concatenate(distances)

    # --- steps ---------------------------------------------------------------------------------------------------

    def _ask(self, points: Float[np.ndarray, "q 3"], size: int) -> tuple[np.ndarray, np.ndarray]:
        buffer = self._points[size]
        buffer.put(points)
        if size not in self._steps:
            self._steps[size] = self._prepared(lambda: self._query(buffer.on_device))
        labels, distances = self._steps[size]()
        return labels[: len(points)].cpu().numpy(), distances[: len(points)].cpu().numpy()

    def _observe(self, depth: Float[Tensor, " n"]) -> Seen:
        """What ``Model.encode`` does, without its loops and checks on the host."""
        valid = depth > 0
        points = self._rays * depth[:, None]
        low = points.masked_fill(~valid[:, None], torch.inf).amin(dim=0)
        high = points.masked_fill(~valid[:, None], -torch.inf).amax(dim=0)
        # without a pixel the box is inside out; numbers must stay numbers until the host has seen the count
        center, extent = ((low + high) / 2).nan_to_num(), (high - low).amax()
        scale = 2 / torch.where(extent > 0, extent, 2.0)
        normalized = ((points - center) * scale).masked_fill(~valid[:, None], 0.0)
        count, limit = valid.sum(), self.model.network.config.points
        order = _farthest(normalized, valid, limit)
        # fewer points than the network takes are repeated
        cloud = normalized[order[torch.arange(limit, device=depth.device) % count.clamp(1, limit)]]
        code = self.model.inference.encode(cloud[None], (-center * scale)[None])
        return Seen(code, center, scale, count)

    def _query(self, points: Float[Tensor, "q 3"]) -> tuple[UInt8[Tensor, " q"], Float[Tensor, " q"]]:
        assert self._seen is not None
        seen = self._seen
        queries = ((points - seen.center) * seen.scale)[None]
        logits, distance, _ = self.model.respond(self.model.inference.query(seen.code, queries), queries)
        return logits[0].argmax(dim=-1).to(torch.uint8), distance[0].float() / seen.scale

    def _prepared(self, work: Callable[[], T]) -> Callable[[], T]:
        """The work as one CUDA graph, whose results are always the same tensors; on a CPU the work itself."""

        def run() -> T:
            with self.model.answering():
                return work()

        if self.model.device.type != "cuda":
            return run
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(WARM_UPS):
                run()
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = run()

        def replay() -> T:
            graph.replay()
            return result

        return replay


class _Buffer:
    """A tensor on the device that is filled from the host without waiting: by way of page-locked memory."""

    def __init__(self, shape: tuple[int, ...], device: torch.device) -> None:
        self.on_device = torch.zeros(shape, device=device)
        self._staged = torch.zeros(shape, pin_memory=device.type == "cuda")
        self._copied = torch.cuda.Event() if device.type == "cuda" else None

    def put(self, values: Float[np.ndarray, "..."]) -> None:
        """The first rows; what was in the others stays."""
        if self._copied is not None:
            self._copied.synchronize()  # the copy before may still be reading
        self._staged[: len(values)].numpy()[...] = values
        self.on_device.copy_(self._staged, non_blocking=True)
        if self._copied is not None:
            self._copied.record()


def _farthest(points: Float[Tensor, "n 3"], valid: Bool[Tensor, " n"], count: int) -> Int[Tensor, " m"]:
    """Rows of valid points in farthest-point order; ties to the earlier pixel on CUDA, and by place on a CPU."""
    if points.is_cuda:
        kernels = gpu_kernels()
        assert kernels is not None
        order: Tensor = kernels.farthest_points(points[None], valid[None], count)[0]
        return order
    rows = np.flatnonzero(valid.numpy())
    found = rows[farthest_point_order(points.numpy()[rows], count)]
    return torch.from_numpy(np.resize(found, count) if len(found) else np.zeros(count, np.int64))
