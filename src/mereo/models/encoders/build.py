"""The encoder that a network's settings ask for."""

from mereo.models.config import NetworkConfig
from mereo.models.encoders.autodecoder import Autodecoder
from mereo.models.encoders.point_transformer import PointTransformer
from mereo.models.encoders.pointnet2 import PointNet2


def make_encoder(config: NetworkConfig) -> PointNet2 | PointTransformer | Autodecoder:
    """Encoder that the settings name; ``ValueError`` where they do not go together."""
    _check(config)
    if config.encoder == "autodecoder":
        return Autodecoder(config.autodecoder, config.latent)
    if config.encoder == "point-transformer":
        return PointTransformer(config.transformer, config.latent)
    return PointNet2(config.pointnet2)


def _check(config: NetworkConfig) -> None:
    """Raise ``ValueError`` naming the setting, its rule and the cure."""
    neighbors = config.additions.local_neighbors
    if config.encoder == "autodecoder" and neighbors:
        raise ValueError(
            f"local_neighbors is {neighbors}, but an autodecoder has no features at points to attend to; train with "
            "--network.local-neighbors 0, or with the preset paper-autodecoder"
        )
    widths = config.transformer.transformer_widths
    if config.encoder == "point-transformer" and len(widths) < 3:
        raise ValueError(
            f"transformer_widths are {widths}; a Point Transformer needs at least three: give for "
            "example 32 64 128 256 512"
        )
