"""Every setting of the system, as frozen dataclasses. Imports neither numpy nor torch, so that ``--help`` is instant.

Defaults are the paper's (Henrich et al., WACV 2024, section 3 and appendix B) unless a comment says otherwise.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, TypedDict

from tyro.conf import OmitArgPrefixes

from mereo.synthesis.config import SENSORS as SENSORS
from mereo.synthesis.config import Sensor as Sensor
from mereo.synthesis.config import SensorConfig as SensorConfig

TEST_SEED_START = 1_000_000
"""Seeds from here up are for testing; generation for training refuses them."""

MIN_POINTS = 32
"""Fewer observed points say too little about an object: they are refused, drawn again, or left as they were."""

TEMPLATE = "template.safetensors"
"""A dataset's file with the segments at rest (``rest_pose``)."""

Encoder = Literal["pointnet2", "point-transformer", "autodecoder"]
Sampler = Literal["volume-uniform", "label-uniform", "sort-sample", "nested-sort-sample"]


@dataclass(frozen=True)
class SamplingConfig:
    """Where training queries are drawn (paper, section 3.2, "Sampling Method for Query Points").

    Attributes:
        sampler: one of the paper's three samplers, or the authors' later NestedSortSample.
        per_segment: points kept for each segment, half inside and half outside except for volume-uniform.
        oversample: SortSample's n / k; 1 keeps about all inside points, 2 points closer to the surface.
        box_margin: each segment's box is extended by this fraction of its size, half on each side.
        uniform_fraction: further points drawn uniformly in the joint box, as a fraction of all per-segment points.
    """

    sampler: Sampler = "sort-sample"
    per_segment: int = 256
    oversample: int = 1
    box_margin: float = 0.5
    uniform_fraction: float = 0.15

    def total(self, segments: int) -> int:
        """Number of queries of one example."""
        return self.per_segment * segments + round(self.uniform_fraction * self.per_segment * segments)


@dataclass(frozen=True)
class GenerateConfig:
    """How one example is made (paper, appendix B).

    Attributes:
        image_size: the depth image is square, in pixels.
        noise_std: Gaussian noise on the depth, standard deviation in scene units.
        points: the observed cloud is kept in farthest-point order, at most this many points.
        sampling: where queries are drawn.
        sensor: what else is wrong with the depth image; nothing in the paper.
    """

    image_size: int = 96
    noise_std: float = 0.1
    points: int = 1024
    # the marker keeps --sampler short on the command line, where --sensor.axial keeps its prefix
    sampling: OmitArgPrefixes[SamplingConfig] = field(default_factory=SamplingConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)


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


Loss = Literal["ce", "l1", "ce+l1", "ce+l1+cd"]
Precision = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True)
class AugmentConfig:
    """Changes made to each training cloud as it is read; all off in the paper's recipe.

    Attributes:
        keep_points: each point survives with a probability drawn from this range.
        hole_probability: chance of cutting one ball out of the cloud (sensor shadows, reflections).
        hole_radius: largest radius of that ball, in normalized units.
        jitter_std: extra depth noise, up to this standard deviation in normalized units.
        roll: turn view and queries about the optical axis, where the scene allows any roll.
    """

    keep_points: tuple[float, float] = (1.0, 1.0)
    hole_probability: float = 0.0
    hole_radius: float = 0.4
    jitter_std: float = 0.0
    roll: bool = False


@dataclass(frozen=True)
class TrainConfig:
    """The training recipe; defaults are the paper's.

    Attributes:
        network: the architecture.
        init: weights to start from, of the same architecture (the numbers of points and neighbours may differ): a
            shipped name or a file; empty is random. Those of another object give all but its segments and template.
        loss: which terms: cross-entropy, L1 on the distance, cosine on the direction.
        l1_weight: the paper's lambda.
        batch: examples per step, over all processes together.
        queries: query points per example and step, a random subset; 0 means all of them.
        epochs: passes over the dataset.
        learning_rate: peak rate.
        code_rate: peak rate of an autodecoder's codes.
        weight_decay: decoupled (AdamW); 0 is the paper's Adam.
        schedule: constant, or linear warm-up followed by a half cosine to zero.
        warmup: fraction of all steps spent warming up.
        clip_norm: largest gradient norm; 0 means no clipping.
        ema_decay: decay of the exponential moving average of the weights that is saved; 0 is off.
        augment: changes to the observed clouds.
        offset_examples: training examples from which the finished network's class offsets are chosen; 0 is off.
        holdout: examples at the end of the dataset kept for the validation curve.
        precision: auto takes bfloat16 on CUDA and on CPUs that are much faster in it.
        compile: torch.compile of the network; auto means where it pays: on CUDA, and for long runs on a CPU.
        seed: initialization, shuffling and augmentation.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    init: str = ""
    loss: Loss = "ce+l1"
    l1_weight: float = 100.0
    batch: int = 40
    queries: int = 0
    epochs: float = 300.0
    learning_rate: float = 5e-4
    code_rate: float = 1e-3
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warmup: float = 0.0
    clip_norm: float = 0.0
    ema_decay: float = 0.0
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    offset_examples: int = 0
    holdout: int = 128
    precision: Precision = "auto"
    compile: Literal["auto", "on", "off"] = "auto"
    seed: int = 0


_MODERN = AugmentConfig(keep_points=(0.5, 1.0), hole_probability=0.4, jitter_std=0.005, roll=True)

_HALF = NetworkConfig(
    neighbors=24,
    ratio1=0.25,
    mlp1=(32, 32, 64),
    mlp2=(64, 64, 128),
    mlp_global=(128, 256, 512),
    width=256,
    local_neighbors=6,
    local_width=64,
    sight_neighbors=4,
    align_points=256,
    rest_template=True,
)


class _Recipe(TypedDict):
    loss: Loss
    l1_weight: float
    queries: int
    learning_rate: float
    weight_decay: float
    schedule: Literal["constant", "cosine"]
    warmup: float
    clip_norm: float
    ema_decay: float
    augment: AugmentConfig
    offset_examples: int


_MODERN_RECIPE = _Recipe(
    loss="ce+l1+cd",
    l1_weight=10.0,
    queries=384,
    learning_rate=2e-3,
    weight_decay=0.01,
    schedule="cosine",
    warmup=0.05,
    clip_norm=1.0,
    ema_decay=0.999,
    augment=_MODERN,
    offset_examples=1000,
)

PresetName = Literal["paper", "paper-autodecoder", "base", "large", "tiny"]

PRESETS: dict[str, TrainConfig] = {
    # as published
    "paper": TrainConfig(),
    # the same for the autodecoder, whose hyperparameters the paper lists apart (appendix B)
    "paper-autodecoder": TrainConfig(network=NetworkConfig(encoder="autodecoder", dropout=0.2), batch=64, epochs=1000),
    # what to train for real, also on a CPU: the paper's network at half its widths, local features at the query, a
    # modern schedule, and many small steps (docs/design/0002-learning.md)
    "base": replace(TrainConfig(network=_HALF, batch=6, epochs=10, **_MODERN_RECIPE), learning_rate=3e-3),
    # the same with the paper's widths and larger steps, for a GPU
    "large": TrainConfig(
        network=NetworkConfig(
            points=1024, neighbors=32, local_neighbors=6, sight_neighbors=4, align_points=256, rest_template=True
        ),
        epochs=100,
        **_MODERN_RECIPE,
    ),
    # two minutes on two CPU cores: for tests and for a first look at one's own object
    "tiny": replace(
        TrainConfig(
            network=NetworkConfig(
                points=256,
                neighbors=16,
                mlp1=(32, 32, 64),
                mlp2=(64, 64, 128),
                mlp_global=(128, 256),
                width=128,
                local_neighbors=4,
                local_width=64,
                sight_neighbors=4,
                align_points=128,
                rest_template=True,
            ),
            batch=32,
            epochs=10,
            holdout=32,
            **_MODERN_RECIPE,
        ),
        queries=256,
        learning_rate=4e-3,
        ema_decay=0.99,
    ),
}
