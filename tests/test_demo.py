"""The demo shows network and fit side by side, and writes the answer that a user gets by default."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mereo.api.frames import load_frame
from mereo.api.objects import Object
from mereo.cli import demo
from mereo.evaluation.sample_views import GUESSED_UNIT_M
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.state import STATE, load_state
from mereo.geometry.solids import Solids
from mereo.io.output_folders import MARKER, new_directory
from mereo.models.model import Model
from mereo.models.trained import EncodedCloud
from mereo.models.weights import load_model


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[EncodedCloud]:
    """One case, coarsely; and every cloud that is encoded for it."""
    monkeypatch.setattr(demo, "_inputs", lambda _: iter([partial(demo._frame_case, "rope")]))
    monkeypatch.setattr(demo, "RESOLUTION", 32)
    encoded: list[EncodedCloud] = []
    encode = Model.encode
    monkeypatch.setattr(Model, "encode", lambda *given: encoded.append(encode(*given)) or encoded[-1])  # type: ignore[func-returns-value]
    return encoded


@pytest.mark.slow
def test_weights_with_a_statistical_model_show_the_fit_and_write_it(
    rope: Model,
    shown: list[EncodedCloud],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert rope.statistical_model is not None
    modes = Registrar(rope, rope.statistical_model, "modes")  # the scene's draws would take long
    monkeypatch.setattr(demo, "load_object", lambda _: Object(rope, None, {"auto": modes}))
    demo.main(tmp_path)
    out = capsys.readouterr().out
    (scores,) = (line.split("│")[2:4] for line in out.splitlines() if "(mIoU)" in line)
    network, fit = (float(score) for score in scores)
    assert fit > network and "network" in out and "fit" in out
    assert f"mereo view {tmp_path / 'rope'}" in out
    assert "the registered model explains" in out
    assert len(shown) == 2, "each answer is timed from the frame on"
    again = load_state(tmp_path / "rope", rope.statistical_model)
    seen = load_frame("rope").cloud.points
    assert np.median(Solids(again.mesh).nearest(seen).distance) < 0.3 * GUESSED_UNIT_M


def test_weights_without_one_show_the_network_alone_and_say_so(
    shown: list[EncodedCloud], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "load_object", lambda name: Object(replace(load_model(name), statistical_model=None)))
    demo.main(tmp_path)
    out = capsys.readouterr().out
    assert out.count("the network's answer: the weights 'rope' carry no statistical model") == 1
    assert "fit" not in out.splitlines()[2] and len(shown) == 1
    assert (tmp_path / "rope/summary.json").is_file() and not (tmp_path / "rope" / STATE).exists()


def test_the_result_of_an_earlier_version_is_kept_and_stops_no_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has no list of its files, so nobody can tell it from somebody's own."""

    def show(_case: object, folder: Path, _console: object) -> dict[str, object]:
        with new_directory(folder, force=True) as directory:
            (directory / "summary.json").write_text("new")
        return {}

    case = SimpleNamespace(name="rope")
    monkeypatch.setattr(demo, "_inputs", lambda _: iter([lambda: case]))
    monkeypatch.setattr(demo, "_show", show)
    (tmp_path / "rope").mkdir()
    (tmp_path / "rope/summary.json").write_text("old")
    for _ in range(2):  # the second time replaces what the first one wrote
        demo.main(tmp_path)
        kept = f"{tmp_path / 'rope'} holds what mereo may not replace; it is kept, and this result is written to"
        assert f"{kept} {tmp_path / 'rope-2'}\n" in capsys.readouterr().out
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["rope", "rope-2"]
    assert (tmp_path / "rope/summary.json").read_text() == "old" and not (tmp_path / "rope" / MARKER).exists()
    assert (tmp_path / "rope-2/summary.json").read_text() == "new"
