"""Baseline of speed: the straightforward implementation of the same network, which is what one writes first.

Float32, eager; the code is concatenated to every query instead of being multiplied once per cloud; normalization is a
layer of its own; farthest-point sampling inside the network, and the encoder run again for every chunk of queries. It
takes its weights from a model and gives its labels. Nearest neighbours, which only local features need, are found as
in the model itself.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.geometry.transforms import Normalizer
from mereo.models.decoder import Code, Decoder, Prediction, line_of_sight
from mereo.models.model import Model
from mereo.models.network import Network

CHUNK = 50_000
"""Number of queries that are answered at once."""


class Rival:
    """Straightforward implementation of a model's answers about one cloud.

    Attributes:
        model: the model whose weights are taken.
        cloud: normalized points of the cloud, in any order.
        normalizer: the way from the user's frame to normalized coordinates.
        viewpoint: the normalized place of the camera.
    """

    def __init__(self, model: Model, cloud: Float[Tensor, "1 n 3"], normalizer: Normalizer) -> None:
        self.model, self.cloud, self.normalizer = model, cloud, normalizer
        self.viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32)).to(cloud.device)

    @torch.inference_mode()
    def logits(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        """Class logits at points in the user's frame, chunk by chunk."""
        normalized = self.normalizer.apply(points).astype(np.float32)
        chunks = []
        for start in range(0, len(normalized), CHUNK):
            queries = torch.from_numpy(normalized[start : start + CHUNK])[None].to(self.cloud.device)
            spread = self.model.class_logits(self._predict(self.model.network, queries), queries)
            chunks.append(spread[0].cpu())
        return torch.cat(chunks).numpy()

    def _predict(self, network: Network, queries: Float[Tensor, "1 q 3"]) -> Prediction:
        count = int(self.cloud.shape[1] * network.config.pointnet2.ratio1)
        first = farthest_points(self.cloud[0], count)
        rest = torch.ones(self.cloud.shape[1], dtype=torch.bool, device=first.device)
        rest[first] = False
        ordered = torch.cat([self.cloud[:, first], self.cloud[:, rest]], dim=1)
        alignment = None if network.aligner is None else network.aligner(ordered).alignment
        encoding = network.encoder(ordered if alignment is None else alignment.apply(ordered))
        code = network.decoder.prepare(encoding, ordered, self.viewpoint, alignment)
        return decode(network.decoder, code, encoding.latent, queries)


def farthest_points(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, " m"]:
    """Rows of points by greedy farthest-point sampling from the first one on; repeated points come last."""
    distance = torch.full((len(points),), torch.inf, device=points.device)
    chosen = [torch.zeros((), dtype=torch.long, device=points.device)]
    while len(chosen) < count:
        distance = torch.minimum(distance, (points - points[chosen[-1]]).square().sum(dim=-1))
        distance[chosen[-1]] = -1.0  # where points are repeated, each is still taken once
        chosen.append(distance.argmax())
    return torch.stack(chosen)


def decode(decoder: Decoder, code: Code, latent: Float[Tensor, "1 z"], queries: Float[Tensor, "1 q 3"]) -> Prediction:
    """Prediction as of ``Decoder.forward``, with the latent vector at every query; the layers are the decoder's own."""
    layers, added = decoder.config.decoder, decoder.config.additions
    everywhere = latent[:, None].expand(-1, queries.shape[1], -1)
    placed = queries if code.alignment is None else code.alignment.apply(queries)
    encoded = decoder.encode(placed) if layers.encode_positions else placed
    rows = [everywhere, encoded]
    if added.local_neighbors:
        rows += [layer(level, placed) for layer, level in zip(decoder.local, code.levels, strict=True)]
    if added.sight_neighbors:
        rows.append(line_of_sight(queries, code.cloud, code.viewpoint, added.sight_neighbors))
    hidden = encoded
    for number, norm in enumerate(decoder.norms):
        if number > 0:
            rows = [hidden]
        if number == layers.skip_after:
            rows += [everywhere, encoded]
            if decoder.lookup is not None:
                rows.append(decoder.lookup(hidden, placed)[1])
        local_layers = decoder.summands(number)
        weight = torch.cat([layer.weight for layer in local_layers], dim=1)
        hidden = nn.functional.linear(torch.cat(rows, dim=-1), weight, local_layers[0].bias)
        hidden = torch.relu(norm(hidden.flatten(0, 1))).unflatten(0, hidden.shape[:2])
    logits, distance, direction = decoder.head(hidden).split([decoder.classes, 1, 3], dim=-1)
    return Prediction(logits, distance[..., 0], direction)
