"""A training that takes seconds."""

from dataclasses import replace

from mereo_learning.config import PRESETS, AugmentConfig

SMALL = replace(
    PRESETS["tiny"],
    network=PRESETS["tiny"].network.changed(points=64, width=48, neighbors=8, mlp_global=(32, 48)),
    batch=8,
    queries=48,
    epochs=2,
    holdout=8,
    augment=AugmentConfig(keep_points=(0.6, 1.0), hole_probability=0.3),
)

TRANSFORMER = replace(
    SMALL,
    network=SMALL.network.changed(
        encoder="point-transformer",
        transformer_widths=(8, 12, 16),
        transformer_neighbors=6,
        align_points=0,
        rest_template=False,
        sight_neighbors=0,
    ),
)
"""Another encoder, and none of what is added to the paper's network."""
