"""Network of encoder and decoder on normalized batches; ``mereo.models.model`` puts it into the user's frame."""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.models.config import NetworkConfig
from mereo.models.decoder import Code, ConditionedMLP, Decoder, Prediction
from mereo.models.encoders import Autodecoder, Encoding, PointNet2, PointTransformer
from mereo.models.neighbors import CloudBatch, QueryBatch, VectorBatch
from mereo.models.rigid_alignment import Alignment, fit_rigid

ALIGNED_QUERIES = 128
"""Queries per example that train the alignment: neighbours say much the same about a nearly rigid motion."""


class TrainingOutput(NamedTuple):
    """Answers of a network in training.

    Attributes:
        prediction: at all queries.
        coarse: rest coordinates from which the alignment is made, at the first ``ALIGNED_QUERIES``; None where the
            network aligns nothing.
    """

    prediction: Prediction
    coarse: Float[Tensor, "b a 3"] | None


class Network(nn.Module):
    """Encoder and decoder on normalized coordinates."""

    def __init__(self, config: NetworkConfig, segments: int) -> None:
        super().__init__()
        self.config, self.segments = config, segments
        self.encoder = make_encoder(config)
        self.decoder = Decoder(config, segments + 1)
        self.aligner = AlignmentNet(config) if config.additions.align_points else None

    def encode(self, cloud: CloudBatch, viewpoint: VectorBatch) -> Code:
        """Code of each cloud, given in farthest-point order; an autodecoder searches for it, in evaluation mode."""
        if isinstance(self.encoder, Autodecoder):
            # the search needs gradients, which tensors of inference mode cannot give
            with torch.inference_mode(False), torch.no_grad():
                return self._search(self.encoder, cloud.clone(), viewpoint.clone())
        return self._encode(cloud, viewpoint, self._align(cloud))

    def _align(self, cloud: CloudBatch) -> Alignment | None:
        return None if self.aligner is None else self.aligner(cloud).alignment

    def _encode(
        self,
        cloud: CloudBatch,
        viewpoint: VectorBatch,
        alignment: Alignment | None,
        index: Int[Tensor, " b"] | None = None,
    ) -> Code:
        if isinstance(self.encoder, Autodecoder):
            assert index is not None, "an autodecoder has codes of its training examples only"
            encoding = Encoding(self.encoder.code(index), ())
        else:
            encoding = self.encoder(cloud if alignment is None else alignment.apply(cloud))
        return self.decoder.prepare(encoding, cloud, viewpoint, alignment)

    def _search(self, encoder: Autodecoder, cloud: CloudBatch, viewpoint: VectorBatch) -> Code:
        alignment = self._align(cloud)

        def prepare(latent: Float[Tensor, "b z"]) -> Code:
            return self.decoder.prepare(Encoding(latent, ()), cloud, viewpoint, alignment)

        return prepare(encoder.search(lambda latent: self.query(prepare(latent), cloud).distance, len(cloud)))

    def query(self, code: Code, points: QueryBatch) -> Prediction:
        """Prediction at each point."""
        return self.decoder(code, points)

    def forward(
        self,
        cloud: CloudBatch,
        viewpoint: VectorBatch,
        points: QueryBatch,
        index: Int[Tensor, " b"] | None = None,
    ) -> TrainingOutput:
        """Predictions at ``points`` for training, with what else a loss looks at.

        ``index`` says which training examples the clouds are: an autodecoder takes their codes.
        """
        alignment, coarse = None, None
        if self.aligner is not None:
            alignment, coarse = self.aligner(cloud, points[:, :ALIGNED_QUERIES])
        return TrainingOutput(self.query(self._encode(cloud, viewpoint, alignment, index), points), coarse)


# --- encoders ---------------------------------------------------------------------------------------------------------


def make_encoder(config: NetworkConfig) -> PointNet2 | PointTransformer | Autodecoder:
    """Encoder that the settings name; ``ValueError`` where they do not go together."""
    neighbors, widths = config.additions.local_neighbors, config.transformer.transformer_widths
    if config.encoder == "autodecoder" and neighbors:
        raise ValueError(
            f"local_neighbors is {neighbors}, but an autodecoder has no features at points to attend to; train with "
            "--network.local-neighbors 0, or with the preset paper-autodecoder"
        )
    if config.encoder == "point-transformer" and len(widths) < 3:
        raise ValueError(
            f"transformer_widths are {widths}; a Point Transformer needs at least three: give for "
            "example 32 64 128 256 512"
        )
    if config.encoder == "autodecoder":
        return Autodecoder(config.autodecoder, config.latent)
    if config.encoder == "point-transformer":
        return PointTransformer(config.transformer, config.latent)
    return PointNet2(config.pointnet2)


# --- alignment --------------------------------------------------------------------------------------------------------

# A small network predicts rest-pose coordinates (normalized object coordinates; Wang et al., CVPR 2019) at the observed
# points; the rigid motion that fits them best takes cloud and queries into the rest pose's frame (docs/learning.md).


class Aligned(NamedTuple):
    """Rigid motion of each cloud, and the rest coordinates predicted at the queries, for the loss."""

    alignment: Alignment
    rest: QueryBatch


class AlignmentNet(nn.Module):
    """Network from a cloud in farthest-point order to its ``Alignment``, by way of rest coordinates."""

    FITTED = 128
    """Observed points whose coordinates are predicted and fitted."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.points = config.additions.align_points
        small = replace(
            config,
            encoder="pointnet2",  # whatever the network's own is: a small cloud needs no other
            pointnet2=replace(config.pointnet2, neighbors=min(config.pointnet2.neighbors, 16), ratio1=0.5),
            decoder=replace(config.decoder, depth=3, skip_after=2, dropout=0.0),
            additions=replace(config.additions, sight_neighbors=0),
        )
        self.encoder = PointNet2(small.pointnet2)
        self.decoder = ConditionedMLP(small, outputs=3)

    def forward(self, cloud: CloudBatch, queries: QueryBatch | None = None) -> Aligned:
        """Alignment of each cloud, and rest coordinates at ``queries`` (none where there are none)."""
        seen = cloud[:, : self.FITTED]
        unused = torch.zeros_like(cloud[:, 0])  # the viewpoint: rest coordinates need no lines of sight
        code = self.decoder.prepare(self.encoder(cloud[:, : self.points]), cloud, unused)
        places = seen if queries is None else torch.cat([seen, queries], dim=1)
        rest, _ = self.decoder.features(code, places)
        alignment = fit_rigid(seen, rest[:, : seen.shape[1]].detach())
        return Aligned(alignment, rest[:, seen.shape[1] :])
