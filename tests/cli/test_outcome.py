"""What programs get of a command: one JSON object on standard output, and an exit status that says how it ended."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from golden_objects import weights_of

from mereo import __main__ as command_line
from mereo.io import progress
from mereo.synthesis.sample_views import load_view

PLIERS = str(weights_of("pliers"))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_previews: None) -> Path:
    """An empty folder that is the working one, with a frame of the rope, a plane, and what is no frame."""
    monkeypatch.chdir(tmp_path)
    np.save("rope.npy", load_view("rope").depth.to_points().points)
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 20), np.linspace(-0.05, 0.05, 20))
    np.save("plane.npy", np.stack([x, y, 0.5 + 0.1 * x * y], axis=2))
    np.save("text.npy", np.array(["no frame"]))
    return tmp_path


def mereo(*arguments: str) -> int:
    return command_line.main([*arguments, "--resolution", "12", "--formats", "glb"])


def test_one_frame_is_one_object_and_the_rest_goes_elsewhere(here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert mereo("reconstruct", "rope.npy", "--weights", "rope", "--method", "network", "--json") == 0
    out, err = capfd.readouterr()
    found = json.loads(out)
    assert found["output"] == "result" and found["unit_m"] is None and found["recognition"]["known"] == "unsure"
    assert [segment["name"] for segment in found["segments"]][:2] == ["base", "segment_1"]
    assert "wrote result in" in err and not Path("result/summary.json").exists()


def test_what_is_not_the_object_has_a_status_of_its_own(
    here: Path, capfd: pytest.CaptureFixture[str], without_turns: None
) -> None:
    assert mereo("reconstruct", "plane.npy", "--weights", PLIERS, "--output", "one", "--json") == 3
    found = json.loads(capfd.readouterr().out)
    assert found["recognition"]["known"] is False and found["unit_m"] is None, "another object's size says nothing"
    several = ("reconstruct", "plane.npy", "rope.npy", "--weights", PLIERS, "--output", "many", "--json")
    assert mereo(*several) == 3
    frames = json.loads(capfd.readouterr().out)["frames"]
    assert [Path(frame["output"]).name for frame in frames] == ["plane", "rope"]
    assert frames[0]["recognition"] == found["recognition"]


def test_a_frame_that_cannot_be_answered_outweighs_it(
    here: Path, capfd: pytest.CaptureFixture[str], without_turns: None
) -> None:
    assert mereo("reconstruct", "plane.npy", "text.npy", "--weights", PLIERS, "--output", "many", "--json") == 2
    out, err = capfd.readouterr()
    assert out == "" and "text.npy" in err


def test_a_stage_is_shown_once_it_takes_long(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "STAGE_S", 0.05)
    with progress.stage("nobody asks"):
        time.sleep(0.2)
    with progress.shown_stages(), progress.stage("short"):
        pass
    assert capfd.readouterr().err == ""
    with progress.shown_stages(), progress.stage("long"):
        for _ in range(200):
            time.sleep(0.05)
            if err := capfd.readouterr().err:
                break
    assert err == "long: 0 s so far\n"
