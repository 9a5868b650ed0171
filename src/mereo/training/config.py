"""Settings of training, and the presets; light, so that the command line may import them.

Defaults are the paper's (Henrich et al., WACV 2024, section 3 and appendix B) unless a comment says otherwise.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, TypedDict

from mereo.models.config import NetworkConfig, Precision

Loss = Literal["ce", "l1", "ce+l1", "ce+l1+cd"]


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
