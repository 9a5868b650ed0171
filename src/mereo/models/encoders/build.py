"""Point cloud encoders: each maps a normalized cloud to an ``Encoding``."""

from mereo.models.config import NetworkConfig
from mereo.models.encoders.autodecoder import Autodecoder
from mereo.models.encoders.point_transformer import PointTransformer
from mereo.models.encoders.pointnet2 import PointNet2


def make_encoder(config: NetworkConfig) -> PointNet2 | PointTransformer | Autodecoder:
    """The encoder that the settings name; ``ValueError`` where they do not go together or are out of range."""
    for name in ("transformer_neighbors", "search_steps"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} is {getattr(config, name)}; it must be at least 1: leave it out for the paper's")
    if not 0 <= config.dropout < 1:
        raise ValueError(
            f"dropout is {config.dropout}; it is a share from 0 to below 1: the paper's autodecoder has 0.2"
        )
    if config.encoder == "autodecoder":
        if config.local_neighbors:
            raise ValueError(
                f"local_neighbors is {config.local_neighbors}, but an autodecoder has no features at points to attend "
                "to; train with --network.local-neighbors 0, or with the preset paper-autodecoder"
            )
        return Autodecoder(config)
    if config.encoder == "pointnet2":
        return PointNet2(config)
    if len(config.transformer_widths) < 3:
        raise ValueError(
            f"transformer_widths are {config.transformer_widths}; a Point Transformer needs at least three: the paper "
            "has 32 64 128 256 512"
        )
    return PointTransformer(config)
