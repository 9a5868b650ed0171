"""The network, and the trained model that a user holds.

``Network`` works on normalized batches; ``Model`` takes clouds and points in the user's frame and units, and answers
in them. The code of a cloud is computed once and then queried as often as one likes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from mereo.aligner import AlignmentNet
from mereo.alignment import Alignment
from mereo.camera import PointCloud
from mereo.config import MIN_POINTS, NetworkConfig
from mereo.decoder import Code, Decoder, Prediction
from mereo.encoders import make_encoder
from mereo.encoders.autodecoder import Autodecoder
from mereo.encoders.encoding import Encoding
from mereo.frame import Normalizer
from mereo.mesh import Color
from mereo.ordering import farthest_point_order

SURE_LOGIT = 20.0
"""Lead of empty space where there can be nothing; trained networks reach about this in plainly empty space."""

DENSE_FACTOR = 8
"""Clouds this many times denser than the network's input are thinned at random first: ordering all is quadratic."""

CPU_QUERY_CHUNK, CUDA_QUERY_CHUNK = 4096, 65536
"""Queries evaluated at once. On a CPU small chunks stay in cache and reuse their memory: half the time of 32768."""

ALIGNED_QUERIES = 128
"""Queries per example that train the alignment: neighbours say much the same about a nearly rigid motion."""

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
"""Lower and upper corner."""


class Network(nn.Module):
    """Encoder and decoder on normalized coordinates."""

    def __init__(self, config: NetworkConfig, segments: int) -> None:
        super().__init__()
        self.config, self.segments = config, segments
        self.encoder = make_encoder(config)
        self.decoder = Decoder(config, segments + 1)
        self.aligner = AlignmentNet(config) if config.align_points else None

    def encode(self, cloud: Float[Tensor, "b n 3"], viewpoint: Float[Tensor, "b 3"]) -> Code:
        """``cloud`` in farthest-point order. An autodecoder searches for its code, in evaluation mode."""
        if isinstance(self.encoder, Autodecoder):
            # the search needs gradients, which tensors of inference mode cannot give
            with torch.inference_mode(False), torch.no_grad():
                return self._search(self.encoder, cloud.clone(), viewpoint.clone())
        return self._encode(cloud, viewpoint, self._align(cloud))

    def _align(self, cloud: Float[Tensor, "b n 3"]) -> Alignment | None:
        return None if self.aligner is None else self.aligner(cloud).alignment

    def _encode(
        self,
        cloud: Float[Tensor, "b n 3"],
        viewpoint: Float[Tensor, "b 3"],
        alignment: Alignment | None,
        index: Int[Tensor, " b"] | None = None,
    ) -> Code:
        if isinstance(self.encoder, Autodecoder):
            assert index is not None, "an autodecoder has codes of its training examples only"
            encoding = Encoding(self.encoder.code(index), ())
        else:
            encoding = self.encoder(cloud if alignment is None else alignment.apply(cloud))
        return self.decoder.prepare(encoding, cloud, viewpoint, alignment)

    def _search(self, encoder: Autodecoder, cloud: Float[Tensor, "b n 3"], viewpoint: Float[Tensor, "b 3"]) -> Code:
        alignment = self._align(cloud)

        def prepare(latent: Float[Tensor, "b z"]) -> Code:
            return self.decoder.prepare(Encoding(latent, ()), cloud, viewpoint, alignment)

        return prepare(encoder.search(lambda latent: self.query(prepare(latent), cloud).distance, len(cloud)))

    def query(self, code: Code, points: Float[Tensor, "b q 3"]) -> Prediction:
        prediction: Prediction = self.decoder(code, points)
        return prediction

    def forward(
        self,
        cloud: Float[Tensor, "b n 3"],
        viewpoint: Float[Tensor, "b 3"],
        points: Float[Tensor, "b q 3"],
        index: Int[Tensor, " b"] | None = None,
    ) -> tuple[
        Float[Tensor, "b q c"],
        Float[Tensor, "b q"],
        Float[Tensor, "b q 3"],
        Float[Tensor, "b q 3"] | None,
        Float[Tensor, "b a 3"] | None,
    ]:
        """What training needs: logits, distance, direction, and rest coordinates twice.

        First those of the template lookup, then those that the alignment is made from, at the first
        ``ALIGNED_QUERIES``; None where the network has no such part. ``index`` says which training examples the clouds
        are: an autodecoder takes their codes.
        """
        alignment, coarse = None, None
        if self.aligner is not None:
            alignment, coarse = self.aligner(cloud, points[:, :ALIGNED_QUERIES])
        prediction = self.query(self._encode(cloud, viewpoint, alignment, index), points)
        return prediction.logits, prediction.distance, prediction.direction, prediction.rest, coarse


@dataclass(frozen=True, eq=False)
class EncodedCloud:
    """One observed cloud, ready to be queried.

    Attributes:
        code: the network's side.
        normalizer: between the user's frame and the network's.
        cloud: the points the network saw, in the user's frame and units.
    """

    code: Code
    normalizer: Normalizer
    cloud: Float[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Answer:
    """What the model says about each point, in the user's frame and units.

    Attributes:
        label: 0 for empty space, i + 1 for the model's segment i.
        probability: of empty space and each segment; rows sum to one.
        distance: to the nearest segment surface, negative inside; NaN from a model that was not trained on distances.
        direction: unit vector towards it; NaN from a model that was not trained on directions.
    """

    label: UInt8[np.ndarray, " n"]
    probability: Float[np.ndarray, "n c"]
    distance: Float[np.ndarray, " n"]
    direction: Float[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Model:
    """A trained network with everything needed to use it.

    Attributes:
        network: in evaluation mode.
        names, colors: of the segments; label i + 1 is names[i].
        provenance: how it was trained: scene, seeds, dataset, recipe, versions.
        loss: the terms it was trained with; what none of them taught is not answered.
        domain: normalized box outside which everything is answered as empty: nothing was ever there in training, and
            a network may say anything where it was never corrected. None means no limit.
        nested: pairs of names (inner, outer), see ``SegmentedMesh``.
    """

    network: Network
    names: tuple[str, ...]
    colors: tuple[Color, ...]
    loss: str = "ce+l1"
    provenance: dict[str, object] = field(default_factory=dict)
    domain: Box | None = None
    nested: tuple[tuple[str, str], ...] = ()

    @property
    def segmented(self) -> bool:
        """Whether it tells segments apart; one trained on distances alone only knows inside from outside."""
        return "ce" in self.loss

    @property
    def device(self) -> torch.device:
        return next(self.network.parameters()).device

    def encode(self, cloud: PointCloud | Float[np.ndarray, "n 3"]) -> EncodedCloud:
        """Points in a camera frame (z forward), any unit, any density. Raises ``ValueError`` on unusable clouds."""
        cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(np.asarray(cloud, dtype=np.float64))
        points = checked_points(cloud)
        normalizer = Normalizer.fit(points)
        limit = self.network.config.points
        normalized = normalizer.apply(thin(points, limit * DENSE_FACTOR)).astype(np.float32)
        order = farthest_point_order(normalized, limit)
        seen = normalized[order]
        padded = seen[np.arange(limit) % len(seen)]
        with torch.inference_mode():
            tensors = [torch.from_numpy(a[None].astype(np.float32)) for a in (padded, normalizer.viewpoint)]
            code = self.network.encode(*(tensor.to(self.device) for tensor in tensors))
        return EncodedCloud(code, normalizer, normalizer.invert(seen.astype(np.float64)))

    def query(self, code: EncodedCloud, points: Float[np.ndarray, "n 3"]) -> Answer:
        """Segment, probabilities, signed distance and direction at each point."""

        def answer(prediction: Prediction, queries: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            logits, distance, direction = self.respond(prediction, queries)
            return logits.softmax(dim=-1), distance, direction

        probability, distance, direction = self._chunked(code, points, answer)
        return Answer(
            label=probability.argmax(axis=-1).astype(np.uint8),
            probability=probability,
            distance=distance / np.float32(code.normalizer.scale),
            direction=direction,
        )

    def logits(self, code: EncodedCloud, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        """Class logits only: what surface extraction needs."""
        return self._chunked(code, points, lambda *found: (self._class_logits(*found),))[0]

    def respond(
        self, prediction: Prediction, queries: Float[Tensor, "b q 3"]
    ) -> tuple[Float[Tensor, "b q c"], Float[Tensor, "b q"], Float[Tensor, "b q 3"]]:
        """Class logits, signed distance and unit direction at normalized queries, in normalized units.

        A head that no term of the loss has trained says nothing: it is NaN.
        """
        distance, direction = prediction.distance, nn.functional.normalize(prediction.direction, dim=-1)
        if "l1" not in self.loss:
            distance = torch.full_like(distance, torch.nan)
        if "cd" not in self.loss:
            direction = torch.full_like(direction, torch.nan)
        return self._class_logits(prediction, queries), distance, direction

    def _class_logits(self, prediction: Prediction, queries: Float[Tensor, "b q 3"]) -> Float[Tensor, "b q c"]:
        logits = prediction.logits
        if not self.segmented:
            # trained on distances alone: inside is one class, and -distance its margin (paper, section 4.4)
            logits = torch.stack([prediction.distance, -prediction.distance], dim=-1)
        if self.domain is None:
            return logits
        low, high = torch.tensor(self.domain, device=queries.device)
        outside = ((queries < low) | (queries > high)).any(dim=-1)
        surely_empty = torch.zeros_like(logits[0, 0])
        surely_empty[0] = SURE_LOGIT
        return torch.where(outside[..., None], surely_empty, logits)

    def _chunked(
        self,
        code: EncodedCloud,
        points: Float[np.ndarray, "n 3"],
        answer: Callable[[Prediction, Tensor], tuple[Tensor, ...]],
    ) -> list[np.ndarray]:
        normalized = code.normalizer.apply(np.asarray(points, dtype=np.float64)).astype(np.float32)
        size = CUDA_QUERY_CHUNK if self.device.type == "cuda" else CPU_QUERY_CHUNK
        chunks = []
        with torch.inference_mode():
            for start in range(0, max(len(normalized), 1), size):
                queries = torch.from_numpy(normalized[start : start + size])[None].to(self.device)
                chunks.append([part[0].cpu() for part in answer(self.network.query(code.code, queries), queries)])
        return [torch.cat(parts).numpy() for parts in zip(*chunks, strict=True)]


def checked_points(cloud: PointCloud) -> Float[np.ndarray, "n 3"]:
    """The cloud's points as float64, or one sentence on why they cannot be used."""
    points = np.asarray(cloud.points, dtype=np.float64)
    if len(points) < MIN_POINTS:
        raise ValueError(
            f"the cloud has {len(points)} points; the encoder needs at least {MIN_POINTS}: "
            "move closer, or check the mask and the depth range"
        )
    if (points[:, 2] <= 0).any():
        raise ValueError(
            f"{int((points[:, 2] <= 0).sum())} of {len(points)} points have z <= 0, behind the camera; the cloud must "
            "be in a camera frame (x right, y down, z forward): turn it, or pass --frame scanner for y-up scans"
        )
    return points


def thin(points: Float[np.ndarray, "n 3"], limit: int) -> Float[np.ndarray, "m 3"]:
    """At most ``limit`` of the points, chosen at random but always the same way."""
    if len(points) <= limit:
        return points
    return points[np.random.default_rng(0).choice(len(points), limit, replace=False)]


def config_from_dict(values: dict[str, object]) -> NetworkConfig:
    """Inverse of ``dataclasses.asdict`` after a trip through JSON; unknown keys raise ``ValueError``.

    Settings that older weights do not state have their defaults: what they switch on did not exist then.
    """
    odd = sorted(set(values) - {f.name for f in fields(NetworkConfig)})
    if odd:
        raise ValueError(f"the network settings differ in {odd[0]!r} from this version of mereo; train again")
    return NetworkConfig(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})  # type: ignore[arg-type]
