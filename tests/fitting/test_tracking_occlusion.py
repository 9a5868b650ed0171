"""What passes in front of a tracked object does not pull it."""

from collections.abc import Callable

import numpy as np
import pytest
from tracked_views import bare, lump_model, mesh_of, rms, vertices, view, whole

from mereo.fitting import tracking as next_fit
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor, Tracker
from mereo.geometry.mesh import SegmentedMesh
from mereo.reconstruction.observation import Observation
from mereo.synthesis.clutter import Capsule
from mereo.synthesis.depth_sensor import SimulatedView


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    return Registrar(None, lump_model())


FRAMES, BEFORE, AFTER = 11, 3, 8


@pytest.fixture(scope="module")
def crossing(registrar: Registrar) -> list[tuple[SegmentedMesh, SimulatedView]]:
    """A tool comes from the side, hides half of an object that bends slowly, and leaves."""
    frames = []
    for number in range(FRAMES):
        mesh = mesh_of(registrar.model, 20, 0.3 * number / FRAMES)
        low, high = vertices(mesh).min(axis=0), vertices(mesh).max(axis=0)
        tool: tuple[Capsule, ...] = ()
        if BEFORE <= number < AFTER:
            share = np.sin(np.pi * (number - BEFORE + 0.5) / (AFTER - BEFORE))
            width, z = high[0] - low[0], 0.9 * low[2]
            x = 0.9 * (low[0] - width + (0.25 + 0.35 * share) * width)
            tool = (Capsule(np.array([x, -200.0, z]), np.array([x, 200.0, z]), 0.9 * width),)
        frames.append((mesh, view(mesh, number, tool)))
    return frames


def errors(
    registrar: Registrar, crossing: list[tuple[SegmentedMesh, SimulatedView]], observed: Callable[..., Observation]
) -> list[float]:
    """Greatest error before, while and after something is in front."""
    with Tracker(registrar, executor=SynchronousExecutor()) as tracker:
        answers = [tracker.follow(observed(one), i / 30, scene_unit=1.0) for i, (_, one) in enumerate(crossing)]
    assert [one.tracking for one in answers] == ["found", *["followed"] * (FRAMES - 1)]
    off = [rms(answer, mesh) for answer, (mesh, _) in zip(answers, crossing, strict=True)]
    return [max(part) for part in (off[:BEFORE], off[BEFORE:AFTER], off[AFTER:])]


@pytest.mark.parametrize("observed", [bare, whole])
def test_what_passes_in_front_does_not_pull_the_object(
    registrar: Registrar,
    crossing: list[tuple[SegmentedMesh, SimulatedView]],
    observed: Callable[..., Observation],
) -> None:
    shown = [int(one.image.valid.sum()) for _, one in crossing]
    assert min(shown[BEFORE:AFTER]) < 0.6 * shown[0]
    before, during, after = errors(registrar, crossing, observed)
    assert max(before, during, after) < 0.6 and during < 1.2 * before


@pytest.mark.slow
def test_without_the_second_hypothesis_it_would_be_pulled(
    registrar: Registrar, crossing: list[tuple[SegmentedMesh, SimulatedView]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(next_fit, "WHOLE", np.inf)
    monkeypatch.setattr(Tracker, "_doubt", lambda *_: "")  # else it would be lost
    before, during, _ = errors(registrar, crossing, bare)
    assert before < 0.6 and during > 2 * before
