"""Settings of networks, of what a loss teaches them, and of where and how exactly they answer.

Light, so that the command line may import them. Defaults are the paper's (Henrich et al., WACV 2024, section 3 and
appendix B) unless a comment says otherwise; what it leaves open is chosen as docs/method.md tells.
"""

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from mereo.geometry.conventions import Facts, WholeNumbers
from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import (
    GROUP,
    Count,
    CountOrNone,
    Depth,
    Exponent,
    Neighbors,
    NeighborsOrNone,
    NotNegative,
    Points,
    Positive,
    ProperFraction,
    Radius,
    Share,
    Width,
    Widths,
    check_bounds,
    check_values,
)

ExportFormat = Literal["onnx", "torch"]
"""For ONNX Runtime, or of torch.export."""

Device = Literal["auto", "cpu", "cuda"]

Encoder = Literal["pointnet2", "point-transformer", "autodecoder"]

Precision = Literal["auto", "float32", "bfloat16"]

Loss = Literal["ce", "l1", "ce+l1", "ce+l1+cd"]
"""Terms by which networks are trained, as options and weights name them."""

HEADS = 4
"""Number of heads of the attention to local features."""


@dataclass(frozen=True)
class InferenceConfig:
    """Settings of where and how exactly a network computes.

    Attributes:
        device: where the network runs; auto takes a CUDA device where there is one.
        precision: of its products: float32 is exact; auto takes bfloat16 on CUDA and on CPUs that are much faster in
            it, where it changes about one label in a thousand (`mereo bench` measures it).
    """

    device: Device = "auto"
    precision: Precision = "auto"

    def __post_init__(self) -> None:
        check_bounds(self)


EXACT = InferenceConfig(precision="float32")
"""Settings for measuring a network: the same figures on every machine."""


@dataclass(frozen=True)
class Supervision:
    """Kinds of truth that a loss has taught a network, and so what it can answer.

    Attributes:
        labels: by cross-entropy ("ce"); a network trained without it only knows inside from outside.
        distances: signed ones, by L1 ("l1").
        directions: to the nearest surface, by their cosine ("cd").
    """

    labels: bool
    distances: bool
    directions: bool

    @classmethod
    def of(cls, loss: str) -> "Supervision":
        """Supervision by the loss of that name, for example "ce+l1"."""
        terms = loss.split("+")
        return cls("ce" in terms, "l1" in terms, "cd" in terms)


class _Part:
    """Settings whose bounds are checked."""

    def __post_init__(self) -> None:
        check_bounds(self, "network.")


@dataclass(frozen=True)
class PointNet2Config(_Part):
    """Settings of PointNet++; sizes are those of its reference implementation.

    Attributes:
        neighbors: largest number of neighbours in a ball of PointNet++, the first in farthest-point order.
        ratio1: share of points kept as centres by PointNet++'s first set abstraction.
        radius1: radius of its balls.
        mlp1: its layer widths.
        ratio2: share of those centres kept by its second set abstraction.
        radius2: radius of that one's balls.
        mlp2: that one's layer widths.
        mlp_global: layer widths before the global max pool; the last one is the latent size of every encoder.
    """

    neighbors: Neighbors = 64
    ratio1: Share = 0.5
    radius1: Radius = 0.2
    mlp1: Widths = (64, 64, 128)
    ratio2: Share = 0.25
    radius2: Radius = 0.4
    mlp2: Widths = (128, 128, 256)
    mlp_global: Widths = (256, 512, 1024)


@dataclass(frozen=True)
class PointTransformerConfig(_Part):
    """Settings of the Point Transformer; sizes are those of its authors' code, the paper says five blocks.

    Attributes:
        transformer_widths: one block of the Point Transformer per width; each has a quarter of the last one's points.
        transformer_neighbors: nearest points that a point of it attends to; half as many in block one.
    """

    transformer_widths: Widths = (32, 64, 128, 256, 512)
    transformer_neighbors: Neighbors = 16


@dataclass(frozen=True)
class AutodecoderConfig(_Part):
    """Settings of the autodecoder.

    Attributes:
        search_steps: steps of the autodecoder's search for a cloud's code.
        search_rate: learning rate of that search.
        code_penalty: weight of a code's squared length in it, added to L1.
        spread_penalty: in its place where above 0: the search is then in units of the trained codes' spread, and so is
            its rate.
    """

    search_steps: Count = 75
    search_rate: Positive = 1e-3
    code_penalty: NotNegative = 1e-4
    spread_penalty: NotNegative = 0.0


@dataclass(frozen=True)
class DecoderConfig:
    """Settings of the decoder, the occupancy predictor.

    Attributes:
        width: channels of each of the decoder's layers.
        depth: number of these layers.
        skip_after: the layer after which the query and the latent vector return; after the last one, never.
        dropout: share of each of these layers' outputs set to zero in training.
        encode_positions: frequency encoding of the query position; off means the three coordinates themselves.
        lowest_exponent: least e of the frequencies 2^e * pi.
        highest_exponent: greatest e of these frequencies.
    """

    width: Width = 512
    depth: Depth = 7
    skip_after: Count = 4
    dropout: ProperFraction = 0.0
    encode_positions: bool = True
    lowest_exponent: Exponent = -4
    highest_exponent: Exponent = 5

    def __post_init__(self) -> None:
        check_bounds(self, "network.")
        if self.lowest_exponent > self.highest_exponent:
            raise ValueError(
                f"network.lowest_exponent is {self.lowest_exponent} and network.highest_exponent is "
                f"{self.highest_exponent}; the lowest must not be above the highest: give for example -4 and 5"
            )
        if self.skip_after > self.depth:
            raise ValueError(
                f"network.skip_after is {self.skip_after}, of {self.depth} layers; the query and the latent vector can "
                f"return after one of them: give for example {max(1, self.depth // 2)}"
            )


@dataclass(frozen=True)
class AdditionsConfig:
    """Settings of what is added to the paper's network, each off by default.

    Attributes:
        local_neighbors: set-abstraction centres per level that a query attends to; 0 switches local features off.
        local_width: channels of that attention.
        sight_neighbors: observed points nearest to the query's line of sight that it compares depth with; 0 is off.
        align_points: points from which the object's rest-pose frame is estimated first; 0 works in the camera frame.
        rest_template: look queries up in the rest pose's model, at predicted rest coordinates.
    """

    local_neighbors: NeighborsOrNone = 0
    local_width: Width = 128
    sight_neighbors: NeighborsOrNone = 0
    align_points: CountOrNone = 0
    rest_template: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, "network.")
        if self.local_width % HEADS:
            raise ValueError(
                f"network.local_width is {self.local_width}; it must be a multiple of its {HEADS} heads: "
                "give for example 128"
            )


PARTS: dict[str, type[Any]] = {
    "pointnet2": PointNet2Config,
    "transformer": PointTransformerConfig,
    "autodecoder": AutodecoderConfig,
    "decoder": DecoderConfig,
    "additions": AdditionsConfig,
}
"""The parts of a network's settings by their place in it."""


@dataclass(frozen=True)
class NetworkConfig:
    """Settings of a network, a part for each encoder, the decoder and what is added to the paper's (section 3.1).

    Weights, runs and options name the settings of all parts side by side (``to_dict``), so their names are unique. The
    parts of encoders other than the chosen one mean nothing, but PointNet++'s: alignments have such an encoder too.

    Attributes:
        encoder: what makes the latent vector of a cloud (docs/design/0009-encoders.md).
        points: the network sees at most this many points, the first in farthest-point order.
        pointnet2: PointNet++.
        transformer: Point Transformer.
        autodecoder: autodecoder.
        decoder: decoder.
        additions: what the paper's network does not have.
    """

    encoder: Encoder = "pointnet2"
    points: Points = 1024
    # empty names keep the options --network.width, --network.mlp1 and so on, without those of the parts
    pointnet2: Annotated[PointNet2Config, GROUP] = PointNet2Config()
    transformer: Annotated[PointTransformerConfig, GROUP] = PointTransformerConfig()
    autodecoder: Annotated[AutodecoderConfig, GROUP] = AutodecoderConfig()
    decoder: Annotated[DecoderConfig, GROUP] = DecoderConfig()
    additions: Annotated[AdditionsConfig, GROUP] = AdditionsConfig()

    def __post_init__(self) -> None:
        check_bounds(self, "network.")

    @property
    def latent(self) -> int:
        """Number of channels of the latent vector."""
        return self.pointnet2.mlp_global[-1]

    @property
    def level_widths(self) -> WholeNumbers:
        """Numbers of channels of the encoder's levels that queries can attend to."""
        if self.encoder == "autodecoder":
            return ()
        if self.encoder == "point-transformer":
            return self.transformer.transformer_widths[1:3]
        return self.pointnet2.mlp1[-1], self.pointnet2.mlp2[-1]

    def to_dict(self) -> JsonObject:
        """All settings by name, those of all parts side by side, as files hold them, which leave out an unused one."""
        settings: JsonObject = {}
        for name, value in asdict(self).items():
            settings |= value if isinstance(value, dict) else {name: value}
        return {name: value for name, value in settings.items() if value or name != "spread_penalty"}

    @classmethod
    def from_dict(cls, settings: Facts) -> "NetworkConfig":
        """Settings from ``to_dict``, also after a trip through JSON.

        Raises:
            ValueError: a name is unknown, or a value of another type or out of its bounds.
        """
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
        for part in (cls, *PARTS.values()):
            check_values(part, given, "network.")
        parts = {
            name: part(**{item.name: given.pop(item.name) for item in fields(part) if item.name in given})
            for name, part in PARTS.items()
        }
        odd = given.keys() - {"encoder", "points"}
        if odd:
            raise ValueError(f"the network settings differ in {min(odd)!r} from this version of mereo; train again")
        return cls(**(parts | given))

    def changed(self, **settings: Any) -> "NetworkConfig":
        """Copy with other values for these settings, whichever parts they belong to."""
        return self.from_dict(self.to_dict() | settings)
