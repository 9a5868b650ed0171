"""Every setting of the system, as frozen dataclasses. Imports neither numpy nor torch, so that ``--help`` is instant.

Defaults are the paper's (Henrich et al., WACV 2024, section 3 and appendix B) unless a comment says otherwise.
"""

from dataclasses import dataclass, field
from typing import Literal

TEST_SEED_START = 1_000_000
"""Seeds from here up are for testing; generation for training refuses them."""

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
    """

    image_size: int = 96
    noise_std: float = 0.1
    points: int = 1024
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
