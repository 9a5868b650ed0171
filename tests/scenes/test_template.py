"""The template: the grid holds the model at rest, the lookup reads it exactly, and begins as nothing."""

from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import one
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.models.decoder import RestLookup
from mereo.models.network import Network
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH, rest_distances
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import synthesize
from mereo_learning.config import PRESETS
from mereo_learning.dataset import Dataset

TINY = PRESETS["tiny"].network
AXIS = torch.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
SPACING = 2 * TEMPLATE_REACH / (TEMPLATE_NODES - 1)


def lookup_of(*fields: torch.Tensor) -> RestLookup:
    lookup = RestLookup(8, len(fields))
    lookup.distance.copy_(torch.stack(fields))
    return lookup


def random_rest(batch: int, queries: int, reach: float = 1.0) -> torch.Tensor:
    return (torch.rand(batch, queries, 3, generator=torch.Generator().manual_seed(4)) * 2 - 1) * reach


def test_linear_fields_are_read_exactly_and_along_the_right_axes() -> None:
    x, y, z = torch.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
    rest = random_rest(3, 50)
    assert torch.allclose(lookup_of(x, y, z).distances(rest), rest, atol=1e-5)
    mixed = lookup_of(0.3 * x - 0.5 * y + 0.1 * z).distances(rest)
    assert torch.allclose(mixed[..., 0], rest @ torch.tensor([0.3, -0.5, 0.1]), atol=1e-5)


def test_grid_of_a_ball_is_its_signed_distance() -> None:
    """A ball fills the rest box: its radius is the unit of length."""
    ball = toy_scene().rest.segments[3]
    grid = rest_distances(one(ball)).astype(np.float64)
    nodes = np.stack(np.meshgrid(*(AXIS.numpy(),) * 3, indexing="ij"), axis=-1)
    assert np.abs(grid[0] - (np.linalg.norm(nodes, axis=-1) - 1)).max() < 0.02  # the ball is a polyhedron


def test_true_rest_coordinates_find_the_right_segment() -> None:
    """Through deformation, camera and sampler: an inside query's rest coordinates lie in its own segment."""
    scene = toy_scene()
    lookup = lookup_of(*torch.from_numpy(rest_distances(scene.rest)).float())
    queries = synthesize(scene, GenerateConfig(image_size=48), example_rng(3, 0)).queries
    inside = np.flatnonzero(queries.labels)
    found = lookup.distances(torch.from_numpy(queries.rest[inside]).float()[None])[0]
    labels = torch.from_numpy(queries.labels[inside].astype(np.int64)) - 1
    own = found[torch.arange(len(inside)), labels]
    assert (own < SPACING / 2).all()  # trilinear reading rounds edges off by less than this
    clear = -own > SPACING / 2
    assert clear.float().mean() > 0.6 and torch.equal(found.argmin(dim=1)[clear], labels[clear])


def test_a_new_lookup_changes_no_answer() -> None:
    torch.manual_seed(0)
    plain = Network(TINY.changed(rest_template=False), segments=3).eval()
    added = Network(TINY, segments=3).eval()
    added.load_state_dict(added.state_dict() | plain.state_dict())
    cloud, viewpoint, queries = random_rest(2, TINY.points), torch.tensor([[0.0, 0.0, -8.0]] * 2), random_rest(2, 9)
    with torch.inference_mode():
        before, after = (network(cloud, viewpoint, queries).prediction for network in (plain, added))
    for answer, same in zip(after[:3], before[:3], strict=True):
        torch.testing.assert_close(answer, same)  # products of other widths may be added in another order
    assert before.rest is None and after.rest.shape == queries.shape


def test_what_is_read_corrects_the_coordinates() -> None:
    """The gradient of the answer reaches the predicted coordinates: towards less distance is towards the segment."""
    x, y, z = torch.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
    lookup = lookup_of((x.square() + y.square() + z.square()).sqrt() - 0.1)
    torch.nn.init.constant_(lookup.read.weight, 1.0)
    rest, seen = lookup(torch.zeros(1, 20, 8), random_rest(1, 20, reach=0.5))
    (slope,) = torch.autograd.grad(seen.sum(), rest)
    assert (torch.nn.functional.cosine_similarity(slope, rest, dim=-1) > 0.9).all()


@pytest.mark.slow
def test_an_older_dataset_gets_its_template_on_resume(tmp_path: Path) -> None:
    scene, settings = toy_scene(), GenerateConfig(image_size=48, points=64, sampling=SamplingConfig(per_segment=8))
    for resume in (False, True):
        generate(scene, tmp_path / "data", settings, examples=2, seed=3, resume=resume)
        template = Dataset.load(tmp_path / "data").template
        assert template is not None and np.array_equal(template.numpy(), rest_distances(scene.rest).astype(np.float32))
        (tmp_path / "data" / "template.safetensors").unlink()
    assert Dataset.load(tmp_path / "data").template is None
