"""Point cloud encoders and loss functions (paper, section 4.4, bar plots)."""

from dataclasses import replace

from mereo.models.config import Encoder, Loss
from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.result import Claim, Result, Row, better, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Score, Store
from mereo_learning.config import AugmentConfig, TrainConfig

QUESTION = "Which encoder and which loss are best?"
COST = "cpu: 11 trainings, 8.5 hours; paper: 55 trainings, 774 million examples shown"

OBJECTS = ("rope", "shapes", "robot", "lizard", "human")
"""Scenes of the paper's comparison."""

ENCODERS: tuple[Encoder, ...] = ("pointnet2", "point-transformer", "autodecoder")
LOSSES: tuple[Loss, ...] = ("ce", "l1", "ce+l1", "ce+l1+cd")


AUTODECODER_RECIPE = "The autodecoder has its own recipe, as in the paper: batch, rates, passes."
"""Note below tables with more than one encoder."""


def recipe(scale: ExperimentScale, encoder: Encoder, loss: Loss) -> TrainConfig | None:
    """Recipe of a scale with another encoder and loss; None where the two do not go together.

    The autodecoder searches its code by distances: a loss without them leaves nothing to search by. It has a recipe of
    its own, and no local features.
    """
    if encoder != "autodecoder":
        return replace(scale.recipe, loss=loss, network=replace(scale.recipe.network, encoder=encoder))
    return None if loss == "ce" else replace(scale.autodecoder, loss=loss)


def features(config: TrainConfig) -> tuple[str, ...]:
    """Words for what a recipe adds to the paper's (docs/learning.md)."""
    additions = config.network.additions
    augment = replace(config.augment, observations=AugmentConfig.observations)
    added = {
        "local features": additions.local_neighbors,
        "lines of sight": additions.sight_neighbors,
        "alignment": additions.align_points,
        "template": additions.rest_template,
        "augmentation": augment != AugmentConfig(),
        "weight decay": config.weight_decay,
        "a falling rate": config.schedule != "constant",
        "clipped gradients": config.clip_norm,
        "averaged weights": config.ema_decay,
        "class offsets": config.offset_examples,
    }
    return tuple(name for name, is_used in added.items() if is_used)


def lacks(scale: ExperimentScale, encoder: Encoder, loss: Loss) -> str:
    """Words for what an encoder's recipe lacks of those that another encoder's has; empty where all are alike."""
    each = {name: recipe(scale, name, loss) for name in ENCODERS}
    chosen = each[encoder]
    others = [result for name, result in each.items() if result is not None and name != encoder]
    assert chosen is not None, "encoder and loss always go together here"
    everything = dict.fromkeys(name for config in others for name in features(config))
    return ", ".join(name for name in everything if name not in features(chosen))


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of one training for each object, encoder and loss; of small scales for one object, as these are eleven."""
    rows: list[Row] = []
    scores: dict[tuple[str, str, str], Score] = {}
    objects = scale.choose(OBJECTS)[: 1 if scale.objects and not scale.chosen else None]
    for scene in objects:
        dataset = store.dataset(scene, GenerateConfig(), scale.examples)
        for encoder in ENCODERS:
            for loss in LOSSES:
                config = recipe(scale, encoder, loss)
                if config is None:
                    continue
                weights = store.run(dataset, config)
                score = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
                scores[scene, encoder, loss] = score
                paper = published()["encoders-losses"].get(scene, {}).get(encoder, {}).get(loss)
                rows.append(Row(scene, f"{encoder}, {loss}", score, paper, lacks(scale, encoder, loss)))
    notes = (
        "L1 alone knows no segments and has no mIoU; cross-entropy alone leaves the autodecoder nothing to search by.",
        AUTODECODER_RECIPE,
    )
    return Result("encoders-losses", "Encoders and losses", scale.name, tuple(rows), _claims(objects, scores), notes)


def _claims(objects: tuple[str, ...], scores: dict[tuple[str, str, str], Score]) -> tuple[Claim, ...]:
    def all_better(scene: str, encoder: str, others: tuple[str, ...]) -> bool:
        return all(
            better(scores[scene, encoder, loss], scores[scene, other, loss])
            for other in others
            for loss in LOSSES
            if (scene, other, loss) in scores
        )

    return (
        Claim(
            "PointNet++ is better than Point Transformer and the autodecoder with every loss.",
            {name: all_better(name, "pointnet2", ("point-transformer", "autodecoder")) for name in objects},
        ),
        Claim(
            "For PointNet++, CE+L1 is better than CE alone in mIoU (the paper's bars say so of Rope and Shapes only).",
            {name: better(scores[name, "pointnet2", "ce+l1"], scores[name, "pointnet2", "ce"]) for name in objects},
        ),
        Claim(
            "For PointNet++, the loss changes IoU by less than 0.06.",
            {
                name: max(scores[name, "pointnet2", loss].iou for loss in LOSSES)
                - min(scores[name, "pointnet2", loss].iou for loss in LOSSES)
                < 0.06
                for name in objects
            },
        ),
    )
