"""Network of encoder and decoder on normalized batches; ``mereo.models.model`` puts it into the user's frame."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.models.alignment_network import AlignmentNet
from mereo.models.config import NetworkConfig
from mereo.models.decoder import Code, Decoder, Prediction
from mereo.models.encoders.autodecoder import Autodecoder
from mereo.models.encoders.build import make_encoder
from mereo.models.encoders.encoding import Encoding
from mereo.models.rigid_alignment import Alignment

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

    def encode(self, cloud: Float[Tensor, "b n 3"], viewpoint: Float[Tensor, "b 3"]) -> Code:
        """Code of each cloud, given in farthest-point order; an autodecoder searches for it, in evaluation mode."""
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
        """Prediction at each point."""
        prediction: Prediction = self.decoder(code, points)
        return prediction

    def forward(
        self,
        cloud: Float[Tensor, "b n 3"],
        viewpoint: Float[Tensor, "b 3"],
        points: Float[Tensor, "b q 3"],
        index: Int[Tensor, " b"] | None = None,
    ) -> TrainingOutput:
        """Predictions at ``points`` for training, with what else a loss looks at.

        ``index`` says which training examples the clouds are: an autodecoder takes their codes.
        """
        alignment, coarse = None, None
        if self.aligner is not None:
            alignment, coarse = self.aligner(cloud, points[:, :ALIGNED_QUERIES])
        return TrainingOutput(self.query(self._encode(cloud, viewpoint, alignment, index), points), coarse)
