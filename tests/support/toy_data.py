"""A closed-form dataset, written as `mereo generate` writes it: two half balls seen from one side.

Segment `left` is the half of the unit ball with x < 0, `right` the other; the ball has a random radius and place. It
needs no renderer and no sampler, so the tests of learning stand on their own.
"""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from safetensors.numpy import save_file
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.geometry.transforms import unit_rows
from mereo.io.object_storage import Place, names_in
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH
from mereo.synthesis.config import TEMPLATE, GenerateConfig, SamplingConfig
from mereo_learning import shards
from mereo_learning.dataset import Dataset

NAMES = ("left", "right")
SHARD = 32

SMALL = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))
"""Settings of examples that are made in no time."""


def make_small_datasets(patch: pytest.MonkeyPatch) -> None:
    """Let generated shards have two examples, and statistical models twelve states."""
    patch.setattr(shards, "SHARD_SIZE", 2)
    patch.setattr(shards, "states_for", lambda _: 12)


def write_small_dataset(output: Path) -> Path:
    """Generate four examples of the toy scene in two shards, by ``SMALL``, and return their directory."""
    with pytest.MonkeyPatch.context() as patch:
        make_small_datasets(patch)
        generate(toy_scene(), output, SMALL, examples=4, seed=3)
    return output


def contents(folder: Place) -> dict[str, bytes]:
    """Files of a stored dataset."""
    return {name: (folder / name).read_bytes() for name in names_in(folder)}


def read_all(data: Dataset) -> SimpleNamespace:
    """All examples of a dataset as they are stored, and the viewpoint in each."""
    stored = data.read(torch.arange(len(data)))
    return SimpleNamespace(**stored, viewpoint=(-stored["center"] * stored["scale"][:, None]).float())


def write_toy_dataset(
    directory: Path,
    examples: int = 64,
    points: int = 96,
    queries: int = 128,
    example: Callable[[Generator, int, int], dict[str, ndarray]] | None = None,
) -> Path:
    """Write the dataset and return its directory; ``example(rng, points, queries)`` makes one of another kind."""
    directory.mkdir(parents=True)
    rng = default_rng(5)
    for number in range(0, examples, SHARD):
        rows = [(example or half_balls)(rng, points, queries) for _ in range(min(SHARD, examples - number))]
        tensors = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
        save_file(tensors, directory / f"shard-{number // SHARD:05d}.safetensors")
    manifest = {
        "scene": "toy",
        "seed": 5,
        "examples": examples,
        "shard_size": SHARD,
        "version": "0",
        "any_roll": False,
        "settings": {"sampling": {"per_segment": 0}},
        "segments": [{"name": name, "color": [50 * i, 90, 200]} for i, name in enumerate(NAMES)],
    }
    (directory / "manifest.json").write_text(json.dumps(manifest))
    save_file({"distance": _template()}, directory / TEMPLATE)
    return directory


def _template() -> ndarray:
    """Signed distances to the two halves of the unit ball; on the far side of the wall, to the wall's plane."""
    axis = np.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = np.sqrt(x**2 + y**2 + z**2) - 1
    return np.stack([np.maximum(ball, x), np.maximum(ball, -x)]).astype(np.float16)


def half_balls(rng: Generator, points: int, queries: int) -> dict[str, ndarray]:
    radius = rng.uniform(5.0, 10.0)
    center = np.array([rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(100, 200)])
    front = unit_rows(rng.normal(size=(points, 3)))
    front[:, 2] = -np.abs(front[:, 2])
    cloud = center + radius * front
    places = center + radius * rng.uniform(-1.4, 1.4, size=(queries, 3))
    offset = (places - center) / radius
    reach = norm(offset, axis=1)
    # distance to the nearest of the sphere and, inside, the wall between the halves
    wall = np.where(reach < 1, np.abs(offset[:, 0]), np.inf)
    distance = np.minimum(np.abs(reach - 1), wall) * np.where(reach < 1, -1, 1) * radius
    labels = np.where(reach >= 1, 0, np.where(offset[:, 0] < 0, 1, 2))
    radial = offset / reach[:, None] * np.where(reach < 1, 1, -1)[:, None]
    across = np.stack([-np.sign(offset[:, 0]), 0 * reach, 0 * reach], axis=1)
    direction = np.where((wall < np.abs(reach - 1))[:, None], across, radial)
    rest = np.where(labels[:, None] > 0, offset, np.nan)
    return example_of(cloud, places, labels=labels, distances=distance, directions=direction, rest=rest)


def example_of(
    cloud: ndarray,
    places: ndarray,
    *,
    labels: ndarray,
    distances: ndarray,
    directions: ndarray,
    rest: ndarray,
) -> dict[str, ndarray]:
    """Arrays of an example as they are stored, of points and distances in the camera's frame and unit."""
    low = cloud.min(axis=0)
    high = cloud.max(axis=0)
    middle, scale = (low + high) / 2, 2 / (high - low).max()
    return {
        "cloud": ((cloud - middle) * scale).astype(np.float32),
        "cloud_count": np.array(len(cloud), np.int32),
        "center": middle,
        "scale": np.array(scale),
        "positions": ((places - middle) * scale).astype(np.float32),
        "labels": labels.astype(np.uint8),
        "distances": (distances * scale).astype(np.float32),
        "directions": directions.astype(np.float16),
        "rest": rest.astype(np.float16),
    }


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    make_small_datasets(monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four examples in two shards."""
    return write_small_dataset(tmp_path_factory.mktemp("whole") / "data")
