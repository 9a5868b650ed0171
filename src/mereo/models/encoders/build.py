"""The encoder that a network's settings ask for, once they are checked."""

from mereo.models.config import NetworkConfig
from mereo.models.encoders.autodecoder import Autodecoder
from mereo.models.encoders.point_transformer import PointTransformer
from mereo.models.encoders.pointnet2 import PointNet2


def make_encoder(config: NetworkConfig) -> PointNet2 | PointTransformer | Autodecoder:
    """Encoder that the settings name; ``ValueError`` where they do not go together or are out of range."""
    _check(config)
    if config.encoder == "autodecoder":
        return Autodecoder(config.autodecoder, config.latent)
    if config.encoder == "point-transformer":
        return PointTransformer(config.transformer, config.latent)
    return PointNet2(config.pointnet2)


def _check(config: NetworkConfig) -> None:
    """Raise ``ValueError`` naming the setting, its rule and the cure."""
    counts = {
        "transformer_neighbors": config.transformer.transformer_neighbors,
        "search_steps": config.autodecoder.search_steps,
    }
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} is {count}; it must be at least 1: leave it out for the paper's")
    dropout, neighbors = config.decoder.dropout, config.additions.local_neighbors
    if not 0 <= dropout < 1:
        raise ValueError(f"dropout is {dropout}; it is a share from 0 to below 1: the paper's autodecoder has 0.2")
    if config.encoder == "autodecoder" and neighbors:
        raise ValueError(
            f"local_neighbors is {neighbors}, but an autodecoder has no features at points to attend to; train with "
            "--network.local-neighbors 0, or with the preset paper-autodecoder"
        )
    widths = config.transformer.transformer_widths
    if config.encoder == "point-transformer" and len(widths) < 3:
        raise ValueError(
            f"transformer_widths are {widths}; a Point Transformer needs at least three: the paper has "
            "32 64 128 256 512"
        )
