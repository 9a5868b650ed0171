"""Where and how exactly a trained network answers; light, so that the command line may import it."""

from dataclasses import dataclass
from typing import Literal

from mereo.training.config import Precision

Device = Literal["auto", "cpu", "cuda"]


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
