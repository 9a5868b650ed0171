"""Settings of networks and of how exactly they answer; light, so that the command line may import them.

Defaults are the paper's (Henrich et al., WACV 2024, section 3 and appendix B) unless a comment says otherwise.
"""

from dataclasses import dataclass
from typing import Literal

Device = Literal["auto", "cpu", "cuda"]


Encoder = Literal["pointnet2", "point-transformer", "autodecoder"]


Precision = Literal["auto", "float32", "bfloat16"]


MOST_ORDERED = 16384
"""Points of one cloud that a program of the GPU can keep: 16 in each of 1024 threads."""


@dataclass(frozen=True)
class InferenceConfig:
    """Where and how exactly the network computes.

    Attributes:
        device: where the network runs; auto takes a CUDA device where there is one.
        precision: of its products: float32 is exact; auto takes bfloat16 on CUDA and on CPUs that are much faster in
            it, where it changes about one label in a thousand (`mereo bench` measures it).
    """

    device: Device = "auto"
    precision: Precision = "auto"


EXACT = InferenceConfig(precision="float32")
"""For measuring a network: the same figures on every machine."""


@dataclass(frozen=True)
class NetworkConfig:
    """Encoder and decoder (paper, section 3.1 and appendix B; PointNet++ sizes from its reference implementation).

    Attributes:
        encoder: what makes the latent vector of a cloud (docs/design/0009-encoders.md).
        points: the network sees at most this many points, the first in farthest-point order.
        neighbors: largest number of neighbours in a ball, the first in farthest-point order.
        ratio1, radius1, mlp1: first set abstraction: share of points kept as centres, ball radius, layer widths.
        ratio2, radius2, mlp2: second set abstraction, the ratio relative to the first level's centres.
        mlp_global: layer widths before the global max pool; the last one is the latent size of every encoder.
        transformer_widths: Point Transformer: one block per width; from one to the next a quarter of the points stay.
        transformer_neighbors: Point Transformer: nearest points that a point attends to; half as many in block one.
        search_steps, search_rate: autodecoder: steps and learning rate of the search for a cloud's code.
        code_penalty: autodecoder: weight of a code's squared length beside the L1 distance.
        width, depth, skip_after: the decoder's layer width, layer count, and after which layer the query returns.
        dropout: share of each decoder layer's outputs set to zero in training.
        encode_positions: frequency encoding of the query position; off means the three coordinates themselves.
        lowest_exponent, highest_exponent: of the frequencies 2^e * pi, both included.
        local_neighbors: set-abstraction centres per level that a query attends to; 0 switches local features off.
        local_width: channels of that attention.
        sight_neighbors: observed points nearest to the query's line of sight that it compares depth with; 0 is off.
        align_points: points from which the object's rest-pose frame is estimated first; 0 works in the camera frame.
        rest_template: look queries up in the rest pose's model, at predicted rest coordinates.
    """

    encoder: Encoder = "pointnet2"
    points: int = 1024
    neighbors: int = 64
    ratio1: float = 0.5
    radius1: float = 0.2
    mlp1: tuple[int, ...] = (64, 64, 128)
    ratio2: float = 0.25
    radius2: float = 0.4
    mlp2: tuple[int, ...] = (128, 128, 256)
    mlp_global: tuple[int, ...] = (256, 512, 1024)
    transformer_widths: tuple[int, ...] = (32, 64, 128, 256, 512)
    transformer_neighbors: int = 16
    search_steps: int = 75
    search_rate: float = 1e-3
    code_penalty: float = 1e-4
    width: int = 512
    depth: int = 7
    skip_after: int = 4
    dropout: float = 0.0
    encode_positions: bool = True
    lowest_exponent: int = -4
    highest_exponent: int = 5
    local_neighbors: int = 0
    local_width: int = 128
    sight_neighbors: int = 0
    align_points: int = 0
    rest_template: bool = False

    @property
    def latent(self) -> int:
        return self.mlp_global[-1]

    @property
    def level_widths(self) -> tuple[int, ...]:
        """Channels of the encoder's levels that queries can attend to."""
        if self.encoder == "autodecoder":
            return ()
        return self.transformer_widths[1:3] if self.encoder == "point-transformer" else (self.mlp1[-1], self.mlp2[-1])
