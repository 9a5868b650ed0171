"""Array shapes are checked in every call while tests run; what many tests need is made once.

Files that are not in the repository are found, or the test that needs them is skipped.
"""

import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from jaxtyping import install_import_hook

# before torch is loaded: the tests' products are small, and others may hold the second core
os.environ.setdefault("OMP_NUM_THREADS", "1")

# a shell makes background processes ignore interrupts, and their children inherit that; tests interrupt children
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# before the first import of mereo: from here on a wrong shape or dtype is an error
install_import_hook(
    ["mereo", "mereo_learning", "mereo_objects", "mereo_experiments", "mereo_serving", "mereo_viewer"],
    "type_checker.check",
)

from mereo_objects import assets  # noqa: E402

if TYPE_CHECKING:
    from mereo.fitting.draws.playback import DrawnStates
    from mereo.models.model import Model
    from mereo.scenes.statistical_model import StatisticalModel

FEW_STATES = 60
"""Random states of a scene, among which a fit of its draws starts in the tests: a tenth of what users have."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Skip a test whose scene needs a mesh or scan that neither mirror nor network has; so where its fixtures do."""
    try:
        return (yield)
    except assets.AssetUnavailable as error:
        pytest.skip(str(error))


pytest_runtest_setup = pytest_runtest_call


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in which the test runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def require_asset() -> Callable[[str], Path]:
    """``require_asset("bunny/bunny.off")`` is the file's path, or the test is skipped."""
    return lambda name: assets.get(name)


@pytest.fixture(scope="session")
def rope() -> "Model":
    """The shipped weights of the rope, for all who do not change them."""
    from mereo.models.weights import load_model

    return load_model("rope")


@pytest.fixture(scope="session")
def toy_model() -> "StatisticalModel":
    """The statistical model of the toy scene, from 200 states."""
    from toy_scene import toy_scene

    from mereo.scenes.random_states import scene_model

    return scene_model(toy_scene(), count=200)


@pytest.fixture(scope="session")
def few_rope_states(rope: "Model") -> "DrawnStates":
    """Random states of the rope, ``FEW_STATES`` of them."""
    from mereo.fitting.draws.playback import DrawnStates
    from mereo.scenes.registry import load_scene

    assert rope.statistical_model is not None
    return DrawnStates.of(load_scene("rope"), rope.statistical_model, FEW_STATES)


@pytest.fixture
def few_states(few_rope_states: "DrawnStates", monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a fit of the rope's draws start among those few, which are made once."""
    from mereo.fitting.draws.playback import DrawnStates

    monkeypatch.setattr(DrawnStates, "of", lambda scene, model: few_rope_states)


@pytest.fixture
def without_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trainings leave an empty curves.png: drawing one takes as long as ten steps of a small network."""
    from mereo_learning import metrics_log

    monkeypatch.setattr(metrics_log, "draw_curves", lambda rows, path: path.write_bytes(b""))


@pytest.fixture
def small_previews(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw small previews: the six large ones of a result take half a second."""
    from mereo.visualization import result_files

    monkeypatch.setattr(
        result_files, "render_cloud_and_segments", partial(result_files.render_cloud_and_segments, size=40)
    )


@pytest.fixture
def server() -> Iterator[object]:
    """A viewer's server on a free port, without pages."""
    from mereo_viewer.server import start_server, stop_server

    started = start_server(0)
    yield started
    stop_server(started)
