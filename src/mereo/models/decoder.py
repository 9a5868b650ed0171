"""Decoder of the network, the occupancy predictor (paper, section 3.1), with optional local features at the query.

Every layer that reads the latent vector is split, ``W [z; x] = W_z z + W_x x``: the latent half is computed once per
cloud and broadcast over its queries, which is exact and removes the (queries x 1084) buffers.

Notation: b clouds, q queries, k neighbours, z latent channels, h hidden channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.config import HEADS, NetworkConfig
from mereo.models.device import exact, linear
from mereo.models.encoders import Encoding, Level
from mereo.models.neighbors import CloudBatch, QueryBatch, VectorBatch, gather, nearest
from mereo.models.rigid_alignment import Alignment
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH

Hidden = Float[Tensor, "b q h"]
"""Hidden features at each query."""

# --- template ---------------------------------------------------------------------------------------------------------

# What an object looks like is known, only its deformation is not: halfway through its layers the decoder predicts where
# in the rest pose a query is, and reads there the signed distance to every segment (docs/learning.md).
#
# Notation: s segments, n grid nodes.

SCALES = (1.0, 8.0, 32.0)
"""Magnifications at which distances are seen, clipped to [-1, 1], so that what is near is resolved finely."""


class RestLookup(nn.Module):
    """Layer from a query's hidden features and place to its rest coordinates and the model's surfaces there.

    Attributes:
        read: from those distances to the decoder's hidden features; the decoder applies it.
        distance: signed distances (``scenes.rest_pose.rest_distances``), a constant of the trained object.
    """

    def __init__(self, width: int, segments: int) -> None:
        super().__init__()
        self.distance: Tensor
        self.register_buffer("distance", torch.ones(segments, *(TEMPLATE_NODES,) * 3))
        self.where = nn.Linear(width, 3)
        self.read = nn.Linear(len(SCALES) * segments, width, bias=False)
        # at first a query is where alignment puts it and nothing is read: a trained network keeps its answers
        for layer in (self.where, self.read):
            nn.init.zeros_(layer.weight)
        nn.init.zeros_(self.where.bias)

    def forward(self, hidden: Hidden, placed: QueryBatch) -> tuple[QueryBatch, Float[Tensor, "b q r"]]:
        """Rest coordinates, and the distances there as ``read`` takes them.

        ``placed`` are the queries in the aligned frame; gradients reach the coordinates through the distances.
        """
        with exact(hidden):
            offset = F.linear(hidden.float(), self.where.weight, self.where.bias)
            rest = placed.float() + offset
            distance = self.distances(rest)
        return rest, torch.cat([(scale * distance).clamp(-1.0, 1.0) for scale in SCALES], dim=-1)

    def distances(self, rest: QueryBatch) -> Float[Tensor, "b q s"]:
        """Signed distance to each segment at rest coordinates, trilinear; beyond the grid that of its border."""
        # grid_sample takes coordinates from the last axis to the first, in [-1, 1]
        places = (rest / TEMPLATE_REACH).flip(-1)[None, :, :, None]
        sampled = F.grid_sample(self.distance[None], places, padding_mode="border", align_corners=True)
        return sampled[0, ..., 0].permute(1, 2, 0)


# --- decoder ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Code:
    """Encoded cloud: all that a query needs to know of it, computed once.

    Attributes:
        latent1, latent2: the latent half of the first layer and of the layer after the skip connection.
        levels: set-abstraction centres with features projected for attention; empty without local features.
        cloud: the observed points, farthest-point order, normalized, in the camera frame.
        viewpoint: the camera's position in normalized coordinates.
        alignment: from the camera frame to the frame in which the levels are; None where it is the same.
    """

    latent1: Float[Tensor, "b h"]
    latent2: Float[Tensor, "b h"]
    levels: tuple[Level, ...]
    cloud: CloudBatch
    viewpoint: VectorBatch
    alignment: Alignment | None = None


class Prediction(NamedTuple):
    """Raw outputs of a network at each query.

    Attributes:
        logits: of the classes, of which 0 is empty space.
        distance: signed, normalized.
        direction: to the nearest surface, camera frame, not yet of unit length.
        rest: rest coordinates (``scenes.rest_pose``), meant inside the object; None where the network predicts none.
    """

    logits: Float[Tensor, "b q c"]
    distance: Float[Tensor, "b q"]
    direction: QueryBatch
    rest: QueryBatch | None = None


class FrequencyEncoding(nn.Module):
    """Layer ``sin(2^e pi x), cos(2^e pi x)`` for every exponent e (paper, equation 2, with negative exponents)."""

    def __init__(self, lowest: int, highest: int) -> None:
        super().__init__()
        # from Python numbers: arithmetic on the device "meta", where weights are described, loads much of torch
        frequency = torch.tensor([torch.pi * 2.0**exponent for exponent in range(lowest, highest + 1)])
        self.frequency: Tensor
        self.register_buffer("frequency", frequency, persistent=False)
        self.channels = 6 * len(frequency)

    def forward(self, points: QueryBatch) -> Float[Tensor, "b q e"]:
        """Sines, then cosines, of each coordinate at each frequency."""
        phase = (points[..., None] * self.frequency).flatten(-2)
        return torch.cat([phase.sin(), phase.cos()], dim=-1)


class LocalAttention(nn.Module):
    """Attention of a query over its nearest set-abstraction centres of one level.

    ``h_k = relu(A f_k + B (x - c_k))``, weights softmax_k(w h_k) for each of four heads, answer sum_k w_k h_k.
    ``A f_k`` is computed once per centre, so a neighbour costs the query only a gather and the small product with B.
    """

    def __init__(self, channels: int, width: int, neighbors: int) -> None:
        super().__init__()
        self.neighbors = neighbors
        self.project = nn.Linear(channels, width)
        self.offset = nn.Linear(4, width, bias=False)
        self.score = nn.Linear(width, HEADS)

    def forward(self, level: Level, queries: QueryBatch) -> Float[Tensor, "b q w"]:
        """Attended features at each query; ``level.features`` are already projected."""
        index = nearest(queries, level.centers, self.neighbors)
        offset = queries[:, :, None] - gather(level.centers, index)
        offset = torch.cat([offset, offset.norm(dim=-1, keepdim=True)], dim=-1)
        hidden = torch.relu(gather(level.features, index) + self.offset(offset))
        weight = self.score(hidden).softmax(dim=2)
        heads = hidden.unflatten(-1, (HEADS, -1))
        return (weight[..., None] * heads).sum(dim=2).flatten(-2)


def line_of_sight(queries: QueryBatch, cloud: CloudBatch, viewpoint: VectorBatch, count: int) -> Float[Tensor, "b q f"]:
    """Evidence of free space: lateral offset and depth difference to the observed points nearest in the image.

    A query in front of them is in seen empty space; one behind is hidden; one with none nearby is outside the
    silhouette. Both the plain values and eight times them, clipped to [-1, 1], so that near is resolved finely.
    """
    rays, seen = queries - viewpoint[:, None], cloud - viewpoint[:, None]
    query_depth = rays[..., 2:].clamp(min=1e-3)
    seen_depth = seen[..., 2:].clamp(min=1e-3)
    query_image, seen_image = rays[..., :2] / query_depth, seen[..., :2] / seen_depth
    index = nearest(query_image, seen_image, count)
    lateral = (gather(seen_image, index) - query_image[:, :, None]) * query_depth[:, :, None]
    depth = gather(seen_depth, index) - query_depth[:, :, None]
    evidence = torch.cat([lateral, depth], dim=-1).flatten(-2)
    return torch.cat([evidence.clamp(-3.0, 3.0), (8.0 * evidence).clamp(-1.0, 1.0)], dim=-1)


class ConditionedMLP(nn.Module):
    """Layers of the decoder, from code and query points to features, whatever is read from them.

    Queries are in the camera frame; the levels of the code may be in an aligned one.
    """

    def __init__(self, config: NetworkConfig, outputs: int, lookup: RestLookup | None = None) -> None:
        super().__init__()
        self.config, self.lookup = config, lookup
        layers, added = config.decoder, config.additions
        self.encode = FrequencyEncoding(layers.lowest_exponent, layers.highest_exponent)
        query = self.encode.channels if layers.encode_positions else 3
        width = layers.width
        self.latent1 = nn.Linear(config.latent, width, bias=False)
        self.latent2 = nn.Linear(config.latent, width, bias=False)
        self.query1 = nn.Linear(query, width, bias=False)
        self.query2 = nn.Linear(query, width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width, bias=False) for _ in range(layers.depth - 1))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width) for _ in range(layers.depth))
        self.local = nn.ModuleList()
        if added.local_neighbors:
            self.local.extend(
                LocalAttention(channels, added.local_width, added.local_neighbors) for channels in config.level_widths
            )
            self.local1 = nn.Linear(len(self.local) * added.local_width, width, bias=False)
        if added.sight_neighbors:
            self.sight1 = nn.Linear(6 * added.sight_neighbors, width, bias=False)
        self.head = nn.Linear(width, outputs)

    def summands(self, number: int) -> list[nn.Linear]:
        """Layers whose sum is normalized in layer ``number``, counted from 0."""
        if number == 0:
            added = self.config.additions
            extra = ("local1",) * bool(added.local_neighbors) + ("sight1",) * bool(added.sight_neighbors)
            return [self.latent1, self.query1, *(getattr(self, name) for name in extra)]
        summands: list[nn.Linear] = [self.hidden[number - 1]]  # type: ignore[list-item]
        if number == self.config.decoder.skip_after:
            summands += [self.latent2, self.query2, *(() if self.lookup is None else (self.lookup.read,))]
        return summands

    def prepare(
        self,
        encoding: Encoding,
        cloud: CloudBatch,
        viewpoint: VectorBatch,
        alignment: Alignment | None = None,
    ) -> Code:
        """Code of each cloud: the part of the work that does not depend on the queries."""
        with exact(cloud):  # pooled features have much in common, and the rest is what counts
            levels = tuple(
                Level(level.centers, attention.project(level.features.float()))  # type: ignore[operator]
                for level, attention in zip(encoding.levels, self.local, strict=False)
            )
            latent = encoding.latent.float()
            return Code(self.latent1(latent), self.latent2(latent), levels, cloud, viewpoint, alignment)

    def features(self, code: Code, queries: QueryBatch) -> tuple[Float[Tensor, "b q f"], QueryBatch | None]:
        """Outputs of the last layer, and the rest coordinates of the lookup on the way, if there is one."""
        layers, added = self.config.decoder, self.config.additions
        placed = queries if code.alignment is None else code.alignment.apply(queries)
        encoded = self.encode(placed) if layers.encode_positions else placed
        with exact(queries):  # up to the first normalization
            rows = [encoded]
            if added.local_neighbors:
                rows += [layer(level, placed) for layer, level in zip(self.local, code.levels, strict=True)]
            if added.sight_neighbors:
                rows.append(line_of_sight(queries, code.cloud, code.viewpoint, added.sight_neighbors))
            hidden = self._activate(0, joint_linear(self.summands(0)[1:], rows, code.latent1))
        rest = None
        for number in range(1, len(self.norms)):
            rows = [hidden]
            latent = None
            if number == layers.skip_after:
                rows = [hidden, encoded]
                latent = code.latent2
                if self.lookup is not None:
                    rest, seen = self.lookup(hidden, placed)
                    rows.append(seen)
            read = [layer for layer in self.summands(number) if layer is not self.latent2]
            hidden = self._activate(number, joint_linear(read, rows, latent))
        return self.head(hidden).float(), rest

    def _activate(self, number: int, hidden: Hidden) -> Hidden:
        """Normalization, ReLU and dropout of layer ``number``, counted from 0."""
        hidden = self.norms[number](hidden.flatten(0, 1)).relu_().unflatten(0, hidden.shape[:2])
        return nn.functional.dropout(hidden, self.config.decoder.dropout, self.training)


def joint_linear(
    layers: Sequence[nn.Linear], rows: Sequence[Float[Tensor, "b q _"]], latent: Float[Tensor, "b h"] | None
) -> Hidden:
    """Sum ``sum_i W_i x_i`` (+ the cloud's ``latent``) as one product of joined rows: it is written once.

    ``rows`` may be fewer, and wider, than ``layers``, as long as the channels match in order.
    """
    weight = torch.cat([layer.weight for layer in layers], dim=1) if len(layers) > 1 else layers[0].weight
    joined = torch.cat(list(rows), dim=-1) if len(rows) > 1 else rows[0]
    bias = layers[0].bias
    if latent is None:
        return linear(joined, weight, bias)
    shift = latent if bias is None else latent + bias
    if len(shift) == 1:
        return linear(joined, weight, shift[0])
    return linear(joined, weight) + shift[:, None]


class Decoder(ConditionedMLP):
    """Decoder from code and query points to class logits, signed distance and direction."""

    def __init__(self, config: NetworkConfig, classes: int) -> None:
        lookup = RestLookup(config.decoder.width, classes - 1) if config.additions.rest_template else None
        super().__init__(config, classes + 4, lookup)
        self.classes = classes

    def forward(self, code: Code, queries: QueryBatch) -> Prediction:
        """Prediction at each query, the direction in the camera frame."""
        features, rest = self.features(code, queries)
        logits, distance, direction = features.split([self.classes, 1, 3], dim=-1)
        if code.alignment is not None:
            direction = code.alignment.turn_back(direction)
        return Prediction(logits, distance[..., 0], direction, rest)
