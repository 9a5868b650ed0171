"""Lookup of queries in the rest pose: what an object looks like is known, only its deformation is not.

Halfway through its layers the decoder predicts where in the rest pose a query is, and reads there, from a grid, the
signed distance to every segment of the model it was trained for. Deformations are smooth, so the position is easy to
learn; thin parts and the borders between segments come from the model, not from weights. Compare canonical templates
(Deformed Implicit Field, Deng et al., CVPR 2021; D-NeRF, Pumarola et al., CVPR 2021), which learn the template too:
docs/design/0004-template.md.

Notation: b clouds, q queries, h hidden channels, s segments, n grid nodes.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.device import exact
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH

SCALES = (1.0, 8.0, 32.0)
"""Magnifications at which distances are seen, clipped to [-1, 1], so that what is near is resolved finely."""


class RestLookup(nn.Module):
    """Layer from a query's hidden features and place to its rest coordinates and the model's surfaces there.

    Attributes:
        read: from those distances to the decoder's hidden features; the decoder applies it.
        distance: signed distances (``scenes.rest_pose.rest_distances``), a constant of the trained object.
    """

    def __init__(self, width: int, segments: int) -> None:
        super().__init__()
        self.distance: Tensor
        self.register_buffer("distance", torch.ones(segments, *(TEMPLATE_NODES,) * 3))
        self.where = nn.Linear(width, 3)
        self.read = nn.Linear(len(SCALES) * segments, width, bias=False)
        # at first a query is where alignment puts it and nothing is read: a trained network keeps its answers
        for layer in (self.where, self.read):
            nn.init.zeros_(layer.weight)
        nn.init.zeros_(self.where.bias)

    def forward(
        self, hidden: Float[Tensor, "b q h"], placed: Float[Tensor, "b q 3"]
    ) -> tuple[Float[Tensor, "b q 3"], Float[Tensor, "b q r"]]:
        """Rest coordinates, and the distances there as ``read`` takes them.

        ``placed`` are the queries in the aligned frame; gradients reach the coordinates through the distances.
        """
        with exact(hidden):
            offset = F.linear(hidden.float(), self.where.weight, self.where.bias)
            rest = placed.float() + offset
            distance = self.distances(rest)
        return rest, torch.cat([(scale * distance).clamp(-1.0, 1.0) for scale in SCALES], dim=-1)

    def distances(self, rest: Float[Tensor, "b q 3"]) -> Float[Tensor, "b q s"]:
        """Signed distance to each segment at rest coordinates, trilinear; beyond the grid that of its border."""
        # grid_sample takes coordinates from the last axis to the first, in [-1, 1]
        places = (rest / TEMPLATE_REACH).flip(-1)[None, :, :, None]
        found = F.grid_sample(self.distance[None], places, padding_mode="border", align_corners=True)
        return found[0, ..., 0].permute(1, 2, 0)
