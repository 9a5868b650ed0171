"""Trained model that a user holds.

``Network`` works on normalized batches; ``Model`` takes clouds and points in the user's frame and units, and answers
in them. The code of a cloud is computed once and then queried as often as one likes.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Names
from mereo.geometry.downsampling import farthest_point_order, random_subset
from mereo.geometry.mesh import Nested, SegmentColors
from mereo.geometry.transforms import Normalizer, Points, Rows
from mereo.models.calibration import Calibration, Scaling
from mereo.models.config import Precision, Supervision
from mereo.models.decoder import ConditionedMLP, Prediction
from mereo.models.device import MOST, in_threads, pick_precision
from mereo.models.encoders import SharedMLP
from mereo.models.neighbors import QueryBatch
from mereo.models.network import Network
from mereo.models.trained import Answer, EncodedCloud, checked_points
from mereo.scenes.statistical_model import StatisticalModel

SURE_LOGIT = 20.0
"""Lead of empty space where there can be nothing; trained networks reach about this in plainly empty space."""

DENSE_FACTOR = 8
"""Density, relative to the network's input, above which clouds are thinned at random: ordering all is quadratic."""

CPU_QUERY_CHUNK, CUDA_QUERY_CHUNK = 2048, 65536
"""Numbers of queries at once. On a CPU small chunks stay in cache and reuse their memory: half the time of 32768."""

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
"""Lower and upper corner of a box, normalized."""


@dataclass(frozen=True, eq=False)
class Model:
    """Trained network with everything needed to use it.

    Attributes:
        network: in evaluation mode, not to be changed once the model has been used.
        names, colors: of the segments; label i + 1 is names[i].
        provenance: how it was trained: scene, seeds, dataset, recipe, versions.
        loss: the terms it was trained with; what none of them taught is not answered.
        domain: normalized box outside which everything is answered as empty: nothing was ever there in training, and
            a network may say anything where it was never corrected. None means no limit.
        nested: pairs of names (inner, outer), see ``SegmentedMesh``.
        precision: of the products; float32 is exact, bfloat16 faster on GPUs and some CPUs (`mereo bench` says what it
            costs), auto takes bfloat16 there.
        statistical_model: of the object's states, which a registration fits; None without.
        calibration: how far the answers can be trusted, as training seeds showed; None where that was not measured.
        name: how the weights were named when they were loaded, a shipped name or a file; "" for others.
    """

    network: Network
    names: Names
    colors: SegmentColors
    loss: str = "ce+l1"
    provenance: dict[str, object] = field(default_factory=dict)
    domain: Box | None = None
    nested: Nested = ()
    precision: Precision = "float32"
    statistical_model: StatisticalModel | None = None
    calibration: Calibration | None = None
    name: str = ""

    def __repr__(self) -> str:
        size = sum(value.numel() for value in self.network.parameters()) / 1e6
        model = self.statistical_model
        modes = "no statistical model" if model is None else counted(model.count, "mode")
        segments = f"{counted(len(self.names), 'segment')}: {listed(self.names)}"
        name = f"{self.name!r}, " if self.name else ""
        return f"Model({name}{segments}; {size:.1f} M parameters, {modes}, on {self.device.type})"

    @property
    def segmented(self) -> bool:
        """Whether the model tells segments apart; one trained on distances alone only knows inside from outside."""
        return self.supervision.labels

    @property
    def supervision(self) -> Supervision:
        """Supervision by the loss that the model was trained with: what of its answers means anything."""
        return Supervision.of(self.loss)

    @cached_property
    def inference(self) -> Network:
        """Network that answers: without normalization layers, made at the first question."""
        return fold_batch_norm(self.network)

    @property
    def device(self) -> torch.device:
        """Device of the network's weights."""
        return next(self.network.parameters()).device

    @property
    def device_type(self) -> str:
        """Kind of this device: "cpu" or "cuda"."""
        return self.device.type

    @property
    def working_dtype(self) -> torch.dtype:
        """Type of the products on this machine: float32 or bfloat16."""
        return pick_precision(self.precision, self.device) or torch.float32

    @property
    def working_precision(self) -> str:
        """Name of ``working_dtype``."""
        return str(self.working_dtype).removeprefix("torch.")

    def encode(self, cloud: PointCloud | Points) -> EncodedCloud:
        """Encoded cloud of points in a camera frame (z forward), any unit, any density.

        Raises ``ValueError`` on unusable clouds.
        """
        cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(np.asarray(cloud, float))
        ordered, normalizer = self.normalized_cloud(cloud)
        seen = ordered[0, : len(cloud)].numpy().astype(float)
        with self.answering():
            viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32))
            code = self.inference.encode(ordered.to(self.device), viewpoint.to(self.device))
        return EncodedCloud(code, normalizer, normalizer.invert(seen))

    def normalized_cloud(self, cloud: PointCloud) -> tuple[Float[Tensor, "1 n 3"], Normalizer]:
        """Cloud as the network sees it, in farthest-point order; repeated where there are too few points.

        Raises ``ValueError`` on unusable clouds.
        """
        points = checked_points(cloud)
        normalizer = Normalizer.fit(points)
        limit = self.network.config.points
        normalized = normalizer.apply(random_subset(points, limit * DENSE_FACTOR)).astype(np.float32)
        seen = normalized[farthest_point_order(normalized, limit)]
        return torch.from_numpy(seen[np.arange(limit) % len(seen)][None]), normalizer

    def query(self, code: EncodedCloud, points: Points) -> Answer:
        """Segment, probabilities, signed distance and direction at each point.

        Raises ``ValueError`` for no points, and for what is no position.
        """
        points = PointCloud(np.asarray(points)).points
        if len(points) == 0:
            raise ValueError("0 points are queried; at least one is needed: give n x 3 positions")

        def answer(prediction: Prediction, queries: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            logits, distance, direction = self.respond(prediction, queries)
            scaled = logits if self.calibration is None else scaled_logits(self.calibration.scaling, logits)
            return logits.argmax(dim=-1).to(torch.uint8), scaled.softmax(dim=-1), distance, direction

        label, probability, distance, direction = self._chunked(code, points, answer)
        return Answer(label, probability, distance / np.float32(code.normalizer.scale), direction)

    def logits(self, code: EncodedCloud, points: Points) -> Rows:
        """Class logits at each point, without the rest of the answer: what surface extraction needs."""
        return self._chunked(code, points, lambda *answer: (self.class_logits(*answer),))[0]

    @property
    def calibrates(self) -> bool:
        """Whether probabilities are calibrated: by the temperature, and biases, of the weights' calibration."""
        return self.calibration is not None and self.calibration.temperature is not None

    def correspond(self, code: EncodedCloud, points: Points) -> tuple[Rows, Points] | None:
        """Class probabilities, not calibrated, and rest coordinates of points; None from a model without template."""
        if self.network.decoder.lookup is None:
            return None

        def answer(prediction: Prediction, queries: Tensor) -> tuple[Tensor, Tensor]:
            assert prediction.rest is not None
            return self.class_logits(prediction, queries).softmax(dim=-1), prediction.rest

        probability, rest = self._chunked(code, points, answer)
        return probability, rest.astype(float)

    def respond(
        self, prediction: Prediction, queries: QueryBatch
    ) -> tuple[Float[Tensor, "b q c"], Float[Tensor, "b q"], QueryBatch]:
        """Class logits, signed distance and unit direction at normalized queries, in normalized units.

        A head that no term of the loss has trained says nothing: it is NaN.
        """
        distance = prediction.distance
        direction = nn.functional.normalize(prediction.direction, dim=-1)
        if not self.supervision.distances:
            distance = torch.full_like(distance, torch.nan)
        if not self.supervision.directions:
            direction = torch.full_like(direction, torch.nan)
        return self.class_logits(prediction, queries), distance, direction

    def class_logits(self, prediction: Prediction, queries: QueryBatch) -> Float[Tensor, "b q c"]:
        """Logits of empty space and each segment; ``queries`` are normalized."""
        logits = prediction.logits
        if not self.segmented:
            # trained on distances alone: inside is one class, and -distance its margin (paper, section 4.4)
            logits = torch.stack([prediction.distance, -prediction.distance], dim=-1)
        if self.domain is None:
            return logits
        low, high = self._limits
        outside = ((queries < low) | (queries > high)).any(dim=-1)
        surely_empty = torch.zeros_like(logits[0, 0])
        surely_empty[0] = SURE_LOGIT
        return torch.where(outside[..., None], surely_empty, logits)

    @cached_property
    def _limits(self) -> Float[Tensor, "2 3"]:
        """The domain's corners, made once: an upload for every chunk would wait for the device."""
        return torch.tensor(self.domain, device=self.device)

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Context of whatever the network computes for a user: no gradients, in the model's precision."""
        dtype = pick_precision(self.precision, self.device)
        with torch.inference_mode(), torch.autocast(self.device.type, dtype, enabled=dtype is not None):
            yield

    def _chunked(
        self,
        code: EncodedCloud,
        points: Points,
        answer: Callable[[Prediction, Tensor], tuple[Tensor, ...]],
    ) -> list[np.ndarray]:
        """Parts of the answers at all points, computed chunk by chunk."""
        normalized = code.normalizer.apply(np.asarray(points, float)).astype(np.float32)
        size, most = (CUDA_QUERY_CHUNK, 1) if self.device.type == "cuda" else (CPU_QUERY_CHUNK, MOST)
        network = self.inference  # made by one thread, this one

        def part(start: int) -> list[Tensor]:
            with self.answering():
                queries = torch.from_numpy(normalized[start : start + size])[None].to(self.device)
                return [values[0].cpu() for values in answer(network.query(code.code, queries), queries)]

        chunks = in_threads(part, range(0, max(len(normalized), 1), size), most)
        return [torch.cat(parts).numpy() for parts in zip(*chunks, strict=True)]


# --- calibrated logits ------------------------------------------------------------------------------------------------


def scaled_logits(scaling: Scaling, logits: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Logits in single precision, divided and with their biases; as they are where neither changes anything."""
    if scaling == Scaling():
        return logits
    divided = logits.float() / scaling.temperature
    return divided if scaling.biases is None else divided + _on_device(scaling.biases, logits.device)


def scaled_array(scaling: Scaling, logits: Rows) -> Rows:
    """``scaled_logits`` of logits that have left their device."""
    return scaled_logits(scaling, torch.from_numpy(logits)).numpy()


@lru_cache(maxsize=16)
def _on_device(biases: tuple[float, ...], device: torch.device) -> Float[Tensor, " c"]:
    """Biases, made once: an upload for every chunk of queries would wait for the device."""
    return torch.tensor(biases, device=device)


# --- batch normalization, fused ---------------------------------------------------------------------------------------

# In evaluation mode normalization is a scale and a shift per channel, ``norm(W x) = (s W) x + t``. Every linear layer
# whose output is normalized therefore takes the scale into its weights and the shift into its bias. Rounding apart,
# nothing changes.

AnyModule = TypeVar("AnyModule", bound=nn.Module)


@torch.inference_mode(False)  # a search for codes needs gradients, which tensors of inference mode cannot give
@torch.no_grad()
def fold_batch_norm(network: AnyModule) -> AnyModule:
    """Copy of a network for inference whose decoders and shared layers have no normalization left.

    Its parameters have other names and meanings: it can be neither trained nor saved. Raises ``ValueError`` for a
    network in training mode, whose normalization depends on the batch.
    """
    if network.training:
        raise ValueError("the network is in training mode; batch normalization can be folded after network.eval() only")
    folded = copy.deepcopy(network).requires_grad_(False)
    for module in folded.modules():
        if isinstance(module, SharedMLP):
            _fold_shared(module)
        elif isinstance(module, ConditionedMLP):
            _fold_conditioned(module)
    return folded


def _fold_shared(mlp: SharedMLP) -> None:
    layers = list(mlp.layers)
    for index, (linear, norm) in enumerate(pairwise(mlp.layers)):
        if isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
            layers[index], layers[index + 1] = fuse_linear_bn_eval(linear, norm), nn.Identity()
    mlp.layers = nn.Sequential(*(layer for layer in layers if not isinstance(layer, nn.Identity)))


def _fold_conditioned(mlp: ConditionedMLP) -> None:
    """Every summand of a layer's input to the normalization is scaled; one of them takes the shift."""
    for number, norm in enumerate(mlp.norms):
        assert isinstance(norm, nn.BatchNorm1d)
        assert norm.running_mean is not None and norm.running_var is not None
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        for summand in mlp.summands(number):
            summand.weight = nn.Parameter(summand.weight * scale[:, None], requires_grad=False)
        takes_shift = mlp.latent1 if number == 0 else mlp.hidden[number - 1]
        takes_shift.bias = nn.Parameter(norm.bias - norm.running_mean * scale, requires_grad=False)
    mlp.norms = nn.ModuleList(nn.Identity() for _ in mlp.norms)
