"""What a GPU does, as far as one can see without: kernels by Triton's interpreter, fixed frames on the CPU."""

import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from mereo.evaluation.sample_views import load_view
from mereo.models import rigid_alignment
from mereo.models.model import Model
from mereo.models.rigid_alignment import fit_rigid
from mereo.models.weights import load_model
from mereo_experiments.speed.stages import StaticFrames, random_points

KERNELS = """
import numpy as np, torch
from mereo.models.ops.triton_kernels import farthest_points, nearest
from mereo.models.ops.neighbors import nearest as expected
from mereo.geometry.downsampling import farthest_point_order

torch.manual_seed(0)
points, valid = torch.randn(2, 300, 3), torch.rand(2, 300) > 0.3
order = farthest_points(points, valid, 64)
for cloud, kept, found in zip(points.numpy(), valid.numpy(), order.numpy(), strict=True):
    rows = np.flatnonzero(kept)
    first = int(np.square(cloud[rows]).sum(axis=1).argmax())
    np.testing.assert_array_equal(found, rows[farthest_point_order(cloud[rows], 64, start=first)])
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
try:
    farthest_points(torch.zeros(1, 20000, 3), torch.ones(1, 20000) > 0, 4)
except ValueError as error:
    assert "at most 16384 can be ordered at once" in str(error)
else:
    raise AssertionError
"""


@pytest.mark.skipif(find_spec("triton") is None, reason="Triton comes with PyTorch's CUDA builds only")
def test_kernels_do_what_the_cpu_does() -> None:
    """In a process of its own, because the interpreter must be chosen before Triton is imported."""
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, "-c", KERNELS], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["bunny", "rope"])
def test_fixed_frames_answer_as_the_model(name: str) -> None:
    model, view = load_model(name), load_view(name)
    frames = StaticFrames(model, view.depth.camera, sizes=(100, 400))
    code = model.encode(view.depth.to_points())
    points = random_points(view, 950)
    expected = model.query(code, points)
    for count in (950, 60):
        frames.see(view.depth.depth)
        labels, distances = frames.ask(points[:count])
        assert labels.dtype == np.uint8 and labels.shape == distances.shape == (count,)
        assert (labels != expected.label[:count]).mean() < 0.005  # rounding: coordinates here are in single precision
        np.testing.assert_allclose(distances, expected.distance[:count], atol=2e-3 / code.normalizer.scale)
    assert set(labels) > {0}


def test_each_image_is_answered_by_itself() -> None:
    """Nothing of one image may stay in the buffers of the next, whose object is smaller and elsewhere."""
    model, view = load_model("rope"), load_view("rope")
    frames = StaticFrames(model, view.depth.camera, sizes=(64,))
    points = random_points(view, 64)
    frames.see(view.depth.depth)
    whole = frames.ask(points)
    part = view.depth.depth.copy()
    part[: np.flatnonzero(part.any(axis=1))[len(part) // 8]] = 0
    frames.see(part)
    other = frames.ask(points)
    fresh = StaticFrames(model, view.depth.camera, sizes=(64,))
    fresh.see(part)
    np.testing.assert_array_equal(other[1], fresh.ask(points)[1])
    assert not np.array_equal(whole[1], other[1])
    frames.see(view.depth.depth)
    np.testing.assert_array_equal(frames.ask(points)[1], whole[1])


def test_few_pixels_are_repeated_and_too_few_refused() -> None:
    model, view = load_model("bunny"), load_view("bunny")
    frames = StaticFrames(model, view.depth.camera, sizes=(64,))
    rows, columns = np.nonzero(view.depth.depth)
    for count in (200, 10, 0):
        few = np.zeros_like(view.depth.depth)
        chosen = slice(None, None, max(1, len(rows) // max(count, 1))) if count else slice(0, 0)
        few[rows[chosen][:count], columns[chosen][:count]] = view.depth.depth[
            rows[chosen][:count], columns[chosen][:count]
        ]
        points = random_points(view, 50)
        frames.see(few)
        if count == 200:
            code = model.encode(replace(view.depth, depth=few).to_points())
            np.testing.assert_allclose(
                frames.ask(points)[1], model.query(code, points).distance, atol=2e-3 / code.normalizer.scale
            )
        else:
            with pytest.raises(ValueError, match=f"the object has {count} pixels; a reconstruction needs at least"):
                frames.ask(points)


def test_what_cannot_be_fixed_is_refused() -> None:
    model, view = load_model("rope"), load_view("rope")
    camera = view.depth.camera
    with pytest.raises(ValueError, match="640 x 480 pixels; at most 16384 .*crop it around the object"):
        StaticFrames(model, replace(camera, width=640, height=480))
    for sizes in ((), (0, 64)):
        with pytest.raises(ValueError, match="at least one number of queries must be prepared"):
            StaticFrames(model, camera, sizes)
    frames = StaticFrames(model, camera, sizes=(64,))
    with pytest.raises(ValueError, match="call see first"):
        frames.ask(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"the image is \(4, 4\); the camera's are"):
        frames.see(np.ones((4, 4)))
    odd = model.network.config.changed(encoder="autodecoder")
    fake = replace(model)
    fake.network.config = odd
    with pytest.raises(ValueError, match="an autodecoder searches for its code"):
        StaticFrames(fake, camera)


def test_rotation_is_the_same_from_either_decomposition(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CUDA graph holds the plain one; it must give the same motion, also where points lie in a plane."""
    source = torch.randn(5, 40, 3, generator=torch.Generator().manual_seed(0))
    source[2, :, 2] = 0.0
    turned = source @ torch.linalg.qr(torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(1)))[0] + 0.3
    expected = fit_rigid(source, turned)
    monkeypatch.setattr(rigid_alignment, "_svd", rigid_alignment.svd3)
    found = fit_rigid(source, turned)
    torch.testing.assert_close(found.rotation, expected.rotation, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.shift, expected.shift, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(found.rotation), torch.ones(5))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", ["bunny", "rope"])
def test_graphs_on_cuda_answer_as_the_cpu(name: str) -> None:
    exact, view = load_model(name), load_view(name)
    fast: Model = replace(load_model(name, "cuda"), precision="float32")
    frames = StaticFrames(fast, view.depth.camera, sizes=(1000,))
    points = random_points(view, 900)
    expected = exact.query(exact.encode(view.depth.to_points()), points)
    for _ in range(3):
        frames.see(view.depth.depth)
        labels, distances = frames.ask(points)
        assert (labels != expected.label).mean() < 0.01
        assert np.abs(distances - expected.distance).mean() < 0.01 * np.ptp(points, axis=0).max()
