"""What a GPU does, as far as one can see without: kernels by Triton's interpreter."""

import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from mereo.evaluation.sample_views import load_view
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo_experiments.speed.stages import random_points

KERNELS = """
import torch
from mereo.models.triton_kernels import nearest
from mereo.models.neighbors import nearest as expected

torch.manual_seed(0)
for axes, count, known in ((3, 6, 100), (2, 4, 1000), (3, 1, 5)):
    queries, others = torch.randn(2, 77, axes), torch.randn(2, known, axes)
    torch.testing.assert_close(nearest(queries, others, count), expected(queries, others, count))
tied = torch.zeros(1, 7, 3)
assert nearest(tied, tied, 3).tolist() == [[[0, 1, 2]] * 7]
for points in (20000, 3):
    try:
        nearest(torch.zeros(1, 2, 3), torch.zeros(1, points, 3), 4)
    except ValueError as error:
        assert f"4 of {points} points are asked for" in str(error)
    else:
        raise AssertionError
"""


@pytest.mark.skipif(find_spec("triton") is None, reason="Triton comes with PyTorch's CUDA builds only")
def test_kernels_do_what_the_cpu_does() -> None:
    """In a process of its own, because the interpreter must be chosen before Triton is imported."""
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, "-c", KERNELS], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", ["bunny", "rope"])
def test_cuda_answers_as_the_cpu(name: str) -> None:
    exact, view = load_model(name), load_view(name)
    fast: Model = replace(load_model(name, "cuda"), precision="float32")
    points, cloud = random_points(view, 900), view.depth.to_points()
    expected, answer = (model.query(model.encode(cloud), points) for model in (exact, fast))
    assert (answer.label != expected.label).mean() < 0.01
    assert abs(answer.distance - expected.distance).mean() < 0.01 * (points.max() - points.min())
