"""Walks through a scene's states, sequences of frames, and the folders that they are recorded in."""

import json
from pathlib import Path

import numpy as np
import pytest
from folder_contents import read_json, run_mereo
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from numpy.testing import assert_allclose, assert_array_equal
from toy_scene import Shear, rest_mesh, toy_scene

from mereo import __main__ as command_line
from mereo.deformation.maps import Deformation
from mereo.geometry.transforms import inverse_rigid
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.scenes.parameters import played_back, random_state
from mereo.scenes.scene import Scene
from mereo.synthesis.clutter import OCCLUDER
from mereo.synthesis.config import SENSORS, SequenceConfig
from mereo.synthesis.recording import (
    Moment,
    is_recording_folder,
    process_weights,
    sequence,
    switches,
    walk,
    write_recording,
)

SHORT = SequenceConfig(seconds=1.0, rate=12.0, occluded=0.5, image_size=48)


def places(scene: Scene, seed: int, times_s: ndarray) -> ndarray:
    states = walk(scene, seed, times_s, change_s=1.0)
    return np.stack([scene.deform(one.deformations).mesh.merged()[0] for one in states])


def test_a_walk_starts_in_the_state_of_its_seed_and_moves_on_smoothly() -> None:
    scene = toy_scene()
    coarse, fine = (places(scene, 3, np.arange(0.0, 2.0, step)) for step in (0.1, 0.05))
    start = scene.deform(random_state(scene, 3).deformations).mesh.merged()[0]
    assert_allclose(coarse[0], start, atol=1e-9)
    assert_allclose(coarse, fine[::2])
    largest = [norm(np.diff(one, axis=0), axis=2).max() for one in (coarse, fine)]
    assert 0.4 < largest[1] / largest[0] < 0.65  # half the time, half the way
    assert norm(coarse[-1] - coarse[0], axis=1).max() > 1.0
    assert not np.allclose(places(scene, 4, np.array([0.0, 1.0])), coarse[[0, 10]])
    weights = process_weights(np.linspace(0.0, 5.3, 50))
    assert_allclose((weights**2).sum(axis=1), 1.0)
    assert weights.min() >= 0 and (np.count_nonzero(weights, axis=1) <= 4).all()


def bent_or_not(rng: Generator) -> tuple[Deformation, ...]:
    shear = 3.0 * float(rng.uniform(-1.0, 1.0))
    is_bent = float(rng.uniform()) < 0.5
    bend = float(rng.uniform(0.1, 0.3)) if is_bent else 0.0
    return 4 * (Shear(shear, bend, 0.0),)


@pytest.mark.parametrize("seed", range(4))
def test_draws_that_decide_what_else_is_drawn_stay_as_they_are(seed: int) -> None:
    scene = Scene("bent or not", rest_mesh(), bent_or_not)
    start = random_state(scene, seed)
    assert switches(scene, start) == {start.calls[1].key}
    states = walk(scene, seed, np.arange(20) / 10, 1.0)
    drawn = np.array([[call.shares[0] for call in one.calls] for one in states])
    assert all(one.keys == start.keys for one in states) and np.ptp(drawn[:, 1]) == 0
    assert np.ptp(drawn[:, 0]) > 0.1 and all(np.ptp(drawn[:, k]) > 0.1 for k in range(2, len(start.calls)))


def refusing(most: float) -> Scene:
    """A scene that draws again until its shear is small, and so refuses most of what lies between its states."""

    def draw(rng: Generator) -> tuple[Deformation, ...]:
        for _ in range(2000):
            a = float(rng.uniform(-1.0, 1.0))
            if abs(abs(a) - 0.5) < most:
                return 4 * (Shear(3.0 * a, 0.0, 0.0),)
        raise ValueError("gave up")

    return Scene("refusing", rest_mesh(), draw)


def test_a_walk_goes_round_what_the_scene_refuses_and_tells_where_that_is_everything() -> None:
    """And does not jump to the other side, from -0.5 to 0.5, where the scene would draw again."""
    states = walk(refusing(0.2), 0, np.arange(20) / 10, 1.0)
    drawn = np.array([2 * one.calls[0].shares[0] - 1 for one in states])
    assert (np.abs(np.abs(drawn) - 0.5) < 0.2).all() and len(np.unique(np.sign(drawn))) == 1 and np.ptp(drawn) > 0.01
    allowed = []

    def draw(rng: Generator) -> tuple[Deformation, ...]:
        a = float(rng.uniform(-1.0, 1.0))
        allowed.append(a) if not allowed else None
        if a != allowed[0]:
            raise ValueError("only the first")
        return 4 * (Shear(a, 0.0, 0.0),)

    with pytest.raises(ValueError, match="refuses the states between its own .* try another --seed, or a slower walk"):
        walk(Scene("stubborn", rest_mesh(), draw), 0, np.arange(3) / 10, 1.0)


def test_a_walk_does_not_jump_between_states_that_are_far_apart() -> None:
    def draw(rng: Generator) -> tuple[Deformation, ...]:
        return 4 * (Shear(90.0 * float(np.sign(rng.uniform(-1.0, 1.0))), 0.0, 0.0),)

    states = walk(Scene("sides", rest_mesh(), draw), 0, np.arange(20) / 10, 1.0)
    drawn = np.array([one.calls[0].shares[0] for one in states])
    assert len(np.unique(drawn > 0.5)) == 1 and np.ptp(drawn) > 0.1


@pytest.fixture(scope="module")
def moments() -> list[Moment]:
    return list(sequence(toy_scene(), SHORT, SENSORS["paper"], 5))


def test_a_tool_passes_in_the_middle_and_the_camera_stays_near(moments: list[Moment]) -> None:
    hidden = [bool((one.seen.source == OCCLUDER).any()) for one in moments]
    start, end = SHORT.hidden_s
    assert any(hidden) and all(start <= one.time_s < end for one, is_on in zip(moments, hidden, strict=True) if is_on)
    assert not any((one.seen.mask & (one.seen.source == OCCLUDER)).any() for one in moments)
    turns = [moments[0].T_world_camera[:3, 2] @ one.T_world_camera[:3, 2] for one in moments]
    assert min(turns) > np.cos(0.6) and moments[3].time_s == pytest.approx(0.25)


def test_a_sequence_of_one_frame_and_test_seeds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(ValueError, match="0.01 s at 30 frames a second are 0 frames; a sequence has at least 2"):
        SequenceConfig(seconds=0.01)
    out = ["scene", "record", "rope", "--output", str(tmp_path / "x"), "--seed", "1000000"]
    assert command_line.main(out) == 2 and not (tmp_path / "x").exists()
    assert "seeds from 1000000 up are for testing: take a smaller one, or say --test" in capsys.readouterr().err


def test_a_recording_holds_frames_and_their_truth_to_be_played_again(tmp_path: Path, moments: list[Moment]) -> None:
    scene = toy_scene()
    write_recording(tmp_path, scene, SHORT, ("paper", SENSORS["paper"]), 5)
    index = read_json(tmp_path / "recording.json")
    truth = np.load(tmp_path / "truth.npz")
    assert is_recording_folder(tmp_path) and len(index["frames"]) == 12 and index["unit_m"] == 0.005
    assert truth["counts"].tolist() == [[len(s.vertices), len(s.faces)] for s in moments[0].mesh.segments]
    assert_array_equal(truth["faces"], moments[0].mesh.merged()[1])
    for number, (moment, frame) in enumerate(zip(moments, index["frames"], strict=True)):
        assert frame["time_s"] == moment.time_s and frame["points"] == moment.seen.object_points
        assert_allclose(truth["vertices"][number], moment.mesh.merged()[0], rtol=1e-5, atol=1e-5)
        image = InputConfig(intrinsics=tmp_path / "camera.json")
        cloud = read_frame(tmp_path / "frames" / frame["file"], image).cloud
        assert_allclose(cloud.points, 0.005 * moment.seen.image.to_points().points, atol=1e-4)
    shares = np.split(truth["draws"][7], np.cumsum(truth["sizes"])[:-1])
    mesh = scene.deform(played_back(scene, 5, shares).deformations).mesh.transformed(
        inverse_rigid(truth["T_world_camera"][7])
    )
    assert_allclose(mesh.merged()[0], truth["vertices"][7], atol=1e-4)


def test_the_command_records_what_stream_answers(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "rope"
    small = ["--seconds", "0.2", "--rate", "10", "--seed", "3"]
    assert run_mereo("scene", "record", "rope", "--output", out, *small) == 0
    printed = capsys.readouterr().out
    assert "2 frames in 0.2 s" in printed and len(list((out / "frames").iterdir())) == 2
    *command, named, name = printed.splitlines()[-1].split()
    assert (named, name) == ("--object", "rope"), "which has weights, that answer sooner"
    assert run_mereo(*command[1:], "--weights", "rope", "--every-frame", "--resolution", "16") == 0
    lines = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert [(one["method"], one["tracked"]) for one in lines] == [("modes", False), ("modes", True)]
    assert all(one["explained"] > 0.9 for one in lines)
