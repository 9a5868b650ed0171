"""Pieces of work in several threads: the same bits, the caller's settings untouched, errors told."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from mereo.evaluation.sample_views import load_view
from mereo.models.config import Precision
from mereo.models.device import in_threads
from mereo.models.model import CPU_QUERY_CHUNK
from mereo.models.weights import load_model
from mereo_experiments.speed.roofline import count_operations


@pytest.fixture
def threads() -> Iterator[None]:
    """The number of torch's threads, put back after the test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_answers_are_the_same_bits_in_any_number_of_threads(precision: Precision) -> None:
    model, view = replace(load_model("bunny"), precision=precision), load_view("bunny")
    code = model.encode(view.depth.to_points())
    points = np.random.default_rng(0).normal(size=(3 * CPU_QUERY_CHUNK + 7, 3)) * 8 + view.depth.to_points().points[0]
    torch.set_num_threads(1)
    alone = model.query(code, points)
    for count in (2, 3):
        torch.set_num_threads(count)
        together = model.query(code, points)
        for name in ("label", "probability", "distance", "direction"):
            assert np.array_equal(getattr(alone, name), getattr(together, name), equal_nan=True), (count, name)
    assert len(np.unique(alone.label)) > 2


@pytest.mark.usefixtures("threads")
def test_each_thread_computes_alone_and_the_callers_number_stays() -> None:
    torch.set_num_threads(2)
    found = in_threads(lambda piece: (piece, torch.get_num_threads()), range(20))
    assert found == [(piece, 1) for piece in range(20)]
    assert torch.get_num_threads() == 2
    assert in_threads(lambda _: torch.get_num_threads(), [0]) == [2]  # one piece has them all
    assert in_threads(lambda _: torch.get_num_threads(), range(5), most=1) == [2] * 5
    torch.set_num_threads(5)
    assert in_threads(lambda _: torch.get_num_threads(), range(2)) == [2, 2]


@pytest.mark.usefixtures("threads")
def test_the_first_error_is_raised_and_the_next_call_works() -> None:
    torch.set_num_threads(2)

    def work(piece: int) -> int:
        if piece >= 3:
            raise ValueError(f"piece {piece}")
        return piece

    with pytest.raises(ValueError, match="piece 3"):
        in_threads(work, range(50))
    assert in_threads(work, range(3)) == [0, 1, 2]


@pytest.mark.usefixtures("threads")
def test_operations_are_counted_whoever_does_them() -> None:
    ones = torch.ones(10, 20)
    torch.set_num_threads(2)
    assert count_operations(lambda: in_threads(lambda _: ones @ ones.T, range(3))) == 3 * 2 * 10 * 20 * 10
    assert torch.get_num_threads() == 2


FORKED = """
import os, torch
from mereo.models.device import in_threads
torch.set_num_threads(2)
assert in_threads(str, range(4)) == list("0123")
child = os.fork()
if not child:
    os._exit(in_threads(str, range(4)) != list("0123"))
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_process_has_threads_of_its_own() -> None:
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], check=True, timeout=60)


FORKED = """
import os, sys, torch
import mereo.models.device
torch.set_num_threads(2)
product = lambda: torch.nn.functional.linear(torch.ones(512, 512), torch.ones(512, 512)).sum().item()
before = product()
child = os.fork()
if child == 0:
    os._exit(0 if product() == before else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_process_that_was_forked_after_an_answer_computes() -> None:
    """OpenMP's threads do not survive a fork: without care it waits for them without end."""
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], timeout=120).returncode == 0
