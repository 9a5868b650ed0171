"""Autodecoder of DeepSDF (Park et al., CVPR 2019), extended to segments by the decoder behind it.

There is no encoder network. Each training example has a code of its own, trained like the weights. The code of a new
cloud is searched for: "the input point cloud is reinterpreted as the locus of points where the signed distance should
be zero" (Henrich et al., appendix B). Segments follow from a code that explains the distances.

Notation: b clouds, n observed points, e training examples, z latent channels.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.models.config import AutodecoderConfig

CODES = "encoder.codes"
"""Name of the training examples' codes among a network's parameters."""


class Autodecoder(nn.Module):
    """Codes of the training examples, and the search for the code of a new cloud.

    Attributes:
        codes: of the training examples; None in a network that is only used.
        mean: their mean, from which a search starts.
        axes: their principal axes, each as long as their standard deviation along it; None where the search does not
            use them.
    """

    def __init__(self, config: AutodecoderConfig, latent: int) -> None:
        super().__init__()
        self.steps, self.rate, self.penalty = config.search_steps, config.search_rate, config.code_penalty
        self.codes: nn.Parameter | None
        self.register_parameter("codes", None)
        self.mean: Tensor
        self.register_buffer("mean", torch.zeros(latent))
        self.spread_penalty = config.spread_penalty
        self.axes: Tensor | None
        self.register_buffer("axes", torch.zeros(latent, latent) if config.spread_penalty else None)

    def add_codes(self, examples: int, length: float) -> None:
        """Make random codes for training, about ``length`` away from the mean (which is zero in a new network)."""
        width = len(self.mean)
        self.codes = nn.Parameter(self.mean + length * torch.randn(examples, width) / math.sqrt(width))

    @torch.no_grad()
    def update_distribution(self) -> None:
        """Take mean and axes of the codes as they are now."""
        if self.codes is None:
            return
        self.mean.copy_(self.codes.mean(dim=0))
        if self.axes is not None:
            centered = (self.codes - self.mean).double()
            variance, axes = torch.linalg.eigh(centered.T @ centered / len(centered))
            self.axes.copy_((variance.clamp(min=0).sqrt() * axes).T)

    def code(self, index: Int[Tensor, " b"]) -> Float[Tensor, "b z"]:
        """Trained codes of training examples."""
        assert self.codes is not None, "weights hold no codes of training examples"
        return nn.functional.embedding(index, self.codes)

    def length_penalty(self, code: Float[Tensor, "b z"]) -> Float[Tensor, " b"]:
        """Gaussian prior on codes, relative to a mean distance (DeepSDF, equations 9 and 10)."""
        return self.penalty * code.square().sum(dim=1)

    def search(
        self, distance: Callable[[Float[Tensor, "b z"]], Float[Tensor, "b n"]], clouds: int
    ) -> Float[Tensor, "b z"]:
        """Codes under which the observed points are nearest to a surface.

        ``distance`` answers with the signed distance at each cloud's observed points. Deterministic, and the clouds of
        a batch do not influence each other. Gradients are taken for the codes only, whatever the caller's mode.
        """
        place = self._start(clouds).requires_grad_()
        optimizer = torch.optim.Adam([place], lr=self.rate)
        for _ in range(self.steps):
            with torch.enable_grad():
                error = distance(self._code_at(place)).abs().mean(dim=1) + self._prior(place)
                (place.grad,) = torch.autograd.grad(error.sum(), place)
            optimizer.step()
        return self._code_at(place).detach()

    def _start(self, clouds: int) -> Float[Tensor, "b z"]:
        """Place of the mean code, in the coordinates of the search."""
        start = self.mean if self.axes is None else torch.zeros_like(self.mean)
        return start.repeat(clouds, 1)

    def _code_at(self, place: Float[Tensor, "b z"]) -> Float[Tensor, "b z"]:
        """Codes at these places: themselves, or so many standard deviations from the mean along each axis."""
        return place if self.axes is None else self.mean + place @ self.axes

    def _prior(self, place: Float[Tensor, "b z"]) -> Float[Tensor, " b"]:
        if self.axes is None:
            return self.length_penalty(place)
        return self.spread_penalty * place.square().sum(dim=1)
