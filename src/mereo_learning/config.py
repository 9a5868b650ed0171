"""Settings of a training: recipe, augmentation, and the presets as one table.

Light, so that the command line may import them.

Defaults are the paper's (Henrich et al., WACV 2024, section 3 and appendix B) unless a comment says otherwise. What it
does not say, such as the optimizer, is chosen as docs/method.md tells.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from mereo.io.bounds import (
    Batch,
    CountOrNone,
    NotNegative,
    Positive,
    Probability,
    ProperFraction,
    Seed,
    ShareRange,
    check_bounds,
)
from mereo.models.config import Loss, NetworkConfig, Precision, Supervision


@dataclass(frozen=True)
class AugmentConfig:
    """Settings of the changes made to each training cloud as it is read; the paper's recipe makes none.

    Attributes:
        keep_points: each point survives with a probability drawn from this range.
        hole_probability: chance of cutting one ball out of the cloud (sensor shadows, reflections).
        hole_radius: largest radius of that ball, in normalized units.
        jitter_std: extra depth noise, up to this standard deviation in normalized units.
        roll: turn view and queries about the optical axis, where the scene allows any roll.
        observations: probability that a random further observation of the example is read in place of its own cloud,
            where the dataset has further ones (mereo generate --observations).
    """

    keep_points: ShareRange = (1.0, 1.0)
    hole_probability: Probability = 0.0
    hole_radius: Positive = 0.4
    jitter_std: NotNegative = 0.0
    roll: bool = False
    observations: Probability = 0.5

    def __post_init__(self) -> None:
        check_bounds(self, "augment.")
        if self.keep_points[0] > self.keep_points[1]:
            raise ValueError(
                f"augment.keep_points is {self.keep_points[0]:g} {self.keep_points[1]:g}; the smaller probability "
                "comes first: give for example 0.5 1"
            )


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training, its recipe; defaults are the paper's.

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
        code_length: root mean square length of these codes at the start: 1 as in DeepSDF's code; short ones learn first
            what examples have in common.
        weight_decay: decoupled (AdamW); at 0 the optimizer is Adam. The paper names none.
        schedule: constant, or linear warm-up followed by a half cosine to zero.
        warmup: fraction of all steps spent warming up.
        clip_norm: largest gradient norm; 0 means no clipping.
        ema_decay: decay of the exponential moving average of the weights that is saved; 0 is off.
        augment: changes to the observed clouds.
        learned_box: answer everything outside the box in which the training examples have segments as empty; the paper
            says nothing of such a box.
        offset_examples: training examples from which the finished network's class offsets are chosen; 0 is off.
        holdout: examples at the end of the dataset kept for the validation curve.
        precision: auto takes bfloat16 on CUDA and on CPUs that are much faster in it.
        compile: torch.compile of the network; auto means where it pays: in long runs.
        seed: initialization, shuffling and augmentation.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    init: str = ""
    loss: Loss = "ce+l1"
    l1_weight: NotNegative = 100.0
    batch: Batch = 40
    queries: CountOrNone = 0
    epochs: Positive = 300.0
    learning_rate: Positive = 5e-4
    code_rate: Positive = 1e-3
    code_length: Positive = 1.0
    weight_decay: NotNegative = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warmup: ProperFraction = 0.0
    clip_norm: NotNegative = 0.0
    ema_decay: ProperFraction = 0.0
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    learned_box: bool = False
    offset_examples: CountOrNone = 0
    holdout: CountOrNone = 128
    precision: Precision = "auto"
    compile: Literal["auto", "on", "off"] = "auto"
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.batch == self.queries == 1:
            raise ValueError(
                "batch and queries are both 1; batch normalization needs several values at a time: give more of either"
            )

    @property
    def supervision(self) -> Supervision:
        """Supervision by the loss."""
        return Supervision.of(self.loss)

    def to_dict(self) -> dict[str, Any]:
        """All settings as files hold them, the network's side by side; those of some runs only where they are used."""
        augment = asdict(self.augment)
        if not self.augment.observations:
            del augment["observations"]
        settings = asdict(self) | {"network": self.network.to_dict(), "augment": augment}
        if self.network.encoder != "autodecoder":
            del settings["code_length"]
        return settings


PresetName = Literal["paper", "paper-autodecoder", "base", "large", "tiny", "tiny-autodecoder"]
"""Recipes to start from.

    paper              as published, as far as it is (docs/method.md)
    paper-autodecoder  the same for the autodecoder, whose hyperparameters the paper lists apart (appendix B)
    base               what to train for real, also on a CPU: the paper's network at half its widths, local features at
                       the query, a modern schedule, and many small steps (docs/learning.md)
    large              the same with the widths of `paper` and larger steps, for a GPU
    tiny               two minutes on two CPU cores: for tests; objects of one's own are learnt by `mereo learn`
    tiny-autodecoder   the paper's autodecoder, as small and in a modern schedule (docs/design/0009-encoders.md)
"""

Table = dict[str, tuple[Any, ...]]
"""Settings with one value for each preset; what no table names is at its default everywhere."""

# fmt: off
_NETWORK: Table = {
    #                    paper             paper-autodecoder base              large             tiny
    "encoder":          ("pointnet2",      "autodecoder",    "pointnet2",      "pointnet2",      "pointnet2"),
    "points":           (1024,             1024,             1024,             1024,             256),
    "neighbors":        (64,               64,               24,               32,               16),
    "ratio1":           (0.5,              0.5,              0.25,             0.5,              0.5),
    "mlp1":             ((64, 64, 128),    (64, 64, 128),    (32, 32, 64),     (64, 64, 128),    (32, 32, 64)),
    "mlp2":             ((128, 128, 256),  (128, 128, 256),  (64, 64, 128),    (128, 128, 256),  (64, 64, 128)),
    "mlp_global":       ((256, 512, 1024), (256, 512, 1024), (128, 256, 512),  (256, 512, 1024), (128, 256)),
    "width":            (512,              512,              256,              512,              128),
    "dropout":          (0.0,              0.2,              0.0,              0.0,              0.0),
    "local_neighbors":  (0,                0,                6,                6,                4),
    "local_width":      (128,              128,              64,               128,              64),
    "sight_neighbors":  (0,                0,                4,                4,                4),
    "align_points":     (0,                0,                256,              256,              128),
    "rest_template":    (False,            False,            True,             True,             True),
}
_RECIPE: Table = {
    #                    paper             paper-autodecoder base              large             tiny
    "loss":             ("ce+l1",          "ce+l1",          "ce+l1+cd",       "ce+l1+cd",       "ce+l1+cd"),
    "l1_weight":        (100.0,            100.0,            10.0,             10.0,             10.0),
    "batch":            (40,               64,               6,                40,               32),
    "queries":          (0,                0,                384,              384,              256),
    "epochs":           (300.0,            1000,             10,               100,              10),
    "learning_rate":    (5e-4,             5e-4,             3e-3,             2e-3,             4e-3),
    "weight_decay":     (0.0,              0.0,              0.01,             0.01,             0.01),
    "schedule":         ("constant",       "constant",       "cosine",         "cosine",         "cosine"),
    "warmup":           (0.0,              0.0,              0.05,             0.05,             0.05),
    "clip_norm":        (0.0,              0.0,              1.0,              1.0,              1.0),
    "ema_decay":        (0.0,              0.0,              0.999,            0.999,            0.99),
    "learned_box":      (False,            False,            True,             True,             True),
    "offset_examples":  (0,                0,                1000,             1000,             1000),
    "holdout":          (128,              128,              128,              128,              32),
}
_AUGMENT: Table = {
    #                    paper             paper-autodecoder base              large             tiny
    "keep_points":      ((1.0, 1.0),       (1.0, 1.0),       (0.5, 1.0),       (0.5, 1.0),       (0.5, 1.0)),
    "hole_probability": (0.0,              0.0,              0.4,              0.4,              0.4),
    "jitter_std":       (0.0,              0.0,              0.005,            0.005,            0.005),
    "roll":             (False,            False,            True,             True,             True),
}
# fmt: on


def _preset(column: int) -> TrainConfig:
    """The recipe of one column."""
    network, recipe, augment = (
        {name: values[column] for name, values in table.items()} for table in (_NETWORK, _RECIPE, _AUGMENT)
    )
    return TrainConfig(network=NetworkConfig.from_dict(network), augment=AugmentConfig(**augment), **recipe)


def _tiny_autodecoder() -> TrainConfig:
    """The published autodecoder with the widths and the schedule of `tiny`, and what else lets it learn in minutes.

    Low frequencies, so that codes in between mean shapes in between; few queries, so that each code is met often; codes
    that begin short, and a search among codes like the trained ones (docs/design/0009-encoders.md).
    """
    tiny = PRESETS["tiny"]
    bare = {"local_neighbors": 0, "sight_neighbors": 0, "align_points": 0, "rest_template": False}
    return replace(
        tiny,
        network=tiny.network.changed(
            encoder="autodecoder", search_rate=0.1, spread_penalty=1e-3, highest_exponent=1, **bare
        ),
        loss="ce+l1",
        queries=64,
        epochs=160,
        code_rate=1e-2,
        code_length=0.16,
        weight_decay=0.0,
        offset_examples=64,
        augment=AugmentConfig(),
        holdout=16,
    )


PRESETS: dict[str, TrainConfig] = {name: _preset(column) for column, name in enumerate(get_args(PresetName)[:-1])}
PRESETS["tiny-autodecoder"] = _tiny_autodecoder()
