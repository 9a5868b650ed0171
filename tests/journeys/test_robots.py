"""Robots of URDF and SDF files: their joints are found in frames by name, and bad files are one sentence."""

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from page_blocks import blocks
from robot_files import LAPTOP, LAPTOP_SDF, write_gripper

import mereo
import mereo.__main__ as command_line
from mereo.cli.stream import FrameAnswer
from mereo.deformation.samplers import RandomMotion
from mereo.geometry.camera import Camera
from mereo.geometry.transforms import inverse_rigid
from mereo.io.robots import read_robot
from mereo.io.writers.meshes import write_positions_ply
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.parameters import parameters, random_state
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth
from mereo.visualization.joints import JointValue

pytest.importorskip("yourdfpy", reason="yourdfpy is not installed: pip install 'mereo[robot]'")

PAGE = Path(__file__).parents[2] / "docs/own-object.md"


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gripper(tmp_path_factory.mktemp("robots"))


def write_frame(path: Path, scene: Scene, share: float, seed: int) -> float:
    """Write a noisy depth image's cloud in metres of a scene whose only free joint is at a share of its range."""
    motion = scene.sample_deformations
    assert isinstance(motion, RandomMotion) and scene.unit_m is not None
    (leader,) = (joint for joint, _ in motion.joints.values() if not joint.follows)
    mesh = scene.deform(motion.at({leader.name: share})).mesh
    rng = np.random.default_rng(seed)
    seen = mesh.transformed(inverse_rigid(scene.workspace.sample(rng, mesh.bounds.mean(axis=0))))
    image = add_depth_noise(render_depth(seen, Camera.from_fov(128, 128, scene.workspace.fov_rad)), 0.1, rng)
    write_positions_ply(path, image.to_points().points * scene.unit_m)
    return float(leader.limits[0] + share * np.ptp(leader.limits)) * (1.0 if leader.turns else scene.unit_m)


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".urdf", ".sdf"])
def test_both_formats_give_links_in_metres_and_joints_by_name(gripper: Path, suffix: str) -> None:
    robot = read_robot(gripper.with_suffix(suffix))
    assert robot.mesh.names == ("palm", "left", "right")  # what is fixed is one segment
    bounds = [[[-0.05, -0.025, -0.055], [0.05, 0.025, 0.015]], [[-0.016, -0.015, 0.017], [0.017, 0.015, 0.077]]]
    for segment, expected in zip(robot.mesh.segments, bounds, strict=False):
        np.testing.assert_allclose(segment.bounds, expected, atol=1e-9)
    assert min(segment.volume for segment in robot.mesh.segments) > 0  # the mirrored mesh faces outwards, too
    assert robot.mesh.segments[1].volume == pytest.approx(robot.mesh.segments[2].volume)
    follower, finger = robot.joints  # the last link first
    assert (finger.name, finger.turns, finger.moved, finger.follows) == ("finger", False, ("left",), "")
    assert (follower.name, follower.moved, follower.follows) == ("other finger", ("right",), "finger")
    np.testing.assert_allclose([finger.pivot, finger.axis], [[-0.01, 0, 0.047], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose([follower.pivot, follower.axis], [[0.01, 0, 0.047], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose([finger.limits, follower.limits], [[0.003, 0.035], [0.0035, 0.0195]], atol=1e-12)
    left_out = ("joint 'spin' is left out, for it moves no segment against others",)
    assert robot.notes == (left_out if suffix == ".urdf" else ())


def test_shapes_of_collisions_stand_in_where_none_are_visual(tmp_path: Path) -> None:
    for suffix, text in ((".urdf", LAPTOP.replace("visual", "collision")), (".sdf", LAPTOP_SDF)):
        path = tmp_path / f"laptop{suffix}"
        path.write_text(text)
        robot, (joint,) = read_robot(path), read_robot(path).joints
        assert robot.mesh.names == ("base", "lid") and joint.turns and joint.moved == ("lid",)
        np.testing.assert_allclose([joint.pivot, joint.axis], [[0, -0.1, 0.016], [1, 0, 0]], atol=1e-9)
        np.testing.assert_allclose(joint.limits, (0.3, 2.2))
        low, high = robot.mesh.bounds
        np.testing.assert_allclose([*low, *high[:2]], [-0.15, -0.1, -0.01, 0.15, 0.1], atol=1e-9)
        assert high[2] == pytest.approx(0.041, abs=1e-4)  # a round part that is joined to the lid


def test_a_scene_file_has_the_joints_and_one_number_moves_both_fingers(
    gripper: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gripper.yaml"
    assert command_line.main(["scene", "new", str(gripper), "--output", str(path)]) in (0, None)
    text = capsys.readouterr().out
    assert "deformations: by its joints, as the file says" in text and "links may" in text and "'spin'" in text
    scene = load_scene(path)
    assert scene.unit_m is not None and np.ptp(scene.rest.bounds[:, 0]) * scene.unit_m == pytest.approx(0.1)
    (slider,) = parameters(random_state(scene, 0))
    assert (slider.group, slider.name) == ("finger", "slide")
    motion, rng = scene.sample_deformations, example_rng(0, 0)
    assert isinstance(motion, RandomMotion)
    palm, left, right = (deform(np.zeros((1, 3)))[0] * scene.unit_m for deform in motion(rng))
    assert 0.003 < -left[0] < 0.035 and right[0] == pytest.approx(-0.5 * left[0] + 0.002)
    np.testing.assert_allclose([*palm, *left[1:], *right[1:]], 0.0, atol=1e-12)
    assert command_line.main(["scene", "check", str(path)]) in (0, None)  # links that overlap are no fault
    assert "note: left and right overlap" in capsys.readouterr().out


def test_joints_without_names_draw_as_before_and_names_are_checked(tmp_path: Path, gripper: Path) -> None:
    path = tmp_path / "gripper.yaml"
    command_line.main(["scene", "new", str(gripper), "--output", str(path)])
    text = path.read_text()
    for old, new, message in (
        ("name: other finger", "name: finger", "two joints are called 'finger'"),
        ("follows: finger", "follows: fingr", "no joint that follows none is called 'fingr': did you mean 'finger'?"),
        ("slide: [0.003, 0.035]", "slide: [0.035, 0.003]", "it must be [least, most]"),
        ("slide: [0.003, 0.035]", "slide: [0.003, 0.035]\n    angle: [0, 1]", "a joint with a name has one value"),
        ("name: other finger\n", "\n", "it follows a joint and has no name"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=re.escape(message)):
            load_scene(path)


FAULTS = {
    "cannot be read as a robot in URDF": ("</robot>", ""),
    "macro file": ('<robot name="laptop">', '<robot xmlns:xacro="http://ros.org/xacro"><xacro:include/>'),
    "has no <parent> or no <child>": ('<parent link="base"/>', ""),
    "a <visual> of its link 'base' has no geometry": ('<box size="0.3 0.2 0.02"/>', ""),
    "names a link that is not in the file": ('<child link="lid"/>', '<child link="cover"/>'),
    "of the kind 'floating'; it must be revolute, continuous, prismatic, fixed": ("revolute", "floating"),
    "has the limits 2.2 and 0.3; it must have two, the lower first": (
        'lower="0.3" upper="2.2"',
        'lower="2.2" upper="0.3"',
    ),
    "has the limits nan and nan; it must have two": ("<limit", "<safety_controller"),
    "mimics 'hinge'; it must be another one": ("<limit", '<mimic joint="hinge"/><limit'),
    "it must be a direction": ("1 0 0", "0 0 0"),
    "has no link with a shape": ("visual", "drawn"),
    "names the mesh 'no.stl', and": ('<sphere radius="0.015"/>', '<mesh filename="no.stl"/>'),
    "no folder above the file has it": ('<sphere radius="0.015"/>', '<mesh filename="package://no/a.stl"/>'),
    "is carried by the joints 'hinge' and 'again'": (
        "</robot>",
        '<joint name="again" type="fixed"><parent link="base"/><child link="lid"/></joint></robot>',
    ),
    "has 0 links that no joint carries": (
        "</robot>",
        '<joint name="again" type="fixed"><parent link="lid"/><child link="base"/></joint></robot>',
    ),
    "has 2 links that no joint carries (base, loose)": ("</robot>", '<link name="loose"/></robot>'),
    "size or limit of 'base' is NaN, infinite or beyond 1e+12": ('size="0.3 0.2 0.02"', 'size="0.3 nan 0.02"'),
}


@pytest.mark.parametrize("message", FAULTS)
def test_a_bad_file_is_one_sentence(message: str, tmp_path: Path) -> None:
    path = tmp_path / "laptop.urdf"
    path.write_text(LAPTOP.replace(*FAULTS[message]))
    with pytest.raises((ValueError, FileNotFoundError), match=re.escape(message)) as error:
        mereo.load_object(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_robot_is_named_alone_and_an_sdf_file_has_one_model(gripper: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a whole robot, and other files are named too"):
        mereo.load_object([gripper, gripper.parents[1] / "meshes/palm.stl"])
    path = tmp_path / "two.sdf"
    path.write_text("<sdf><world><model name='a'/><model name='b'/></world></sdf>")
    with pytest.raises(ValueError, match="it has 2 models; it must have one"):
        mereo.load_object(path)


# --- frames -----------------------------------------------------------------------------------------------------------


def test_the_angle_of_a_hinge_is_found_with_its_interval(tmp_path: Path) -> None:
    (tmp_path / "laptop.urdf").write_text(LAPTOP)
    laptop = mereo.load_object(tmp_path)  # the folder of a robot's file
    assert laptop.scene is not None
    true = write_frame(tmp_path / "frame.ply", laptop.scene, 0.6, 0)
    assert true == pytest.approx(0.3 + 0.6 * 1.9)  # the file's angle, although its rest pose is closed
    result = mereo.reconstruct(tmp_path / "frame.ply", laptop, unit_m=1.0)
    joint = result.joints["hinge"]
    facts = FrameAnswer.of(result).facts  # what a line of a stream has
    assert facts["joints"] == {"hinge": joint.facts()}
    np.testing.assert_allclose(facts["segments"]["lid"]["pose"], result["lid"].pose, atol=1e-6)
    assert np.trace(result["lid"].pose_in("base")) == pytest.approx(2 + 2 * np.cos(joint.value), abs=1e-6)
    assert pickle.loads(pickle.dumps(result)).joints == result.joints
    assert joint.interval is not None and joint.interval[0] < true < joint.interval[1]
    assert abs(np.rad2deg(joint.value - true)) < 1.0 and joint.unit == "rad"
    np.testing.assert_allclose(joint.limits, (0.3, 2.2))
    assert re.fullmatch(r"82\.\d+° \(82\.\d+ to 82\.\d+\)", str(joint))


def test_the_commands_of_the_page_give_the_joints_of_a_gripper(
    gripper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(gripper.parent)
    true = write_frame(Path("frame.ply"), scene_of_meshes([Path("gripper.urdf")]), 0.5, 2)
    section = tmp_path / "section.md"
    section.write_text(PAGE.read_text().partition("## From a URDF or SDF")[2].partition("\n## ")[0])
    (commands,), (code,) = blocks(section, "bash"), blocks(section, "python")
    for line in commands.splitlines():
        command_line.main(line.partition("#")[0].split()[1:])
    printed = capsys.readouterr().out
    facts = json.loads(Path("result/summary.json").read_text())["joints"]
    assert set(facts) == {"finger", "other finger"} and facts["finger"]["unit"] == "m"
    for name, expected in (("finger", true), ("other finger", 0.5 * true + 0.002)):
        assert facts[name]["value"] == pytest.approx(expected, abs=0.001)
        assert facts[name]["interval"][0] < expected < facts[name]["interval"][1]
        value, (least, most) = facts[name]["value"], facts[name]["interval"]
        assert f"joint {name}: {JointValue(value, (least, most), 'm', (0.0, 1.0))}" in printed
    variables: dict[str, object] = {}
    exec(compile(code, "own-object.md", "exec"), variables)
    result = variables["result"]
    assert isinstance(result, mereo.Result)
    assert result.joints["finger"].value == pytest.approx(facts["finger"]["value"], abs=1e-6)
