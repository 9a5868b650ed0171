"""Robots of URDF and SDF files: their joints are found in frames by name, and bad files are one sentence."""

import json
import pickle
import re
from collections.abc import Sequence
from math import pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from analytic import untrained
from folder_contents import read_json, run_mereo
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from page_blocks import blocks
from robot_files import ARM, LAMP, LAPTOP, LAPTOP_SDF, SALAMANDER, write_arm, write_gripper
from trimesh.creation import box

import mereo
import mereo.__main__ as command_line
from mereo.cli.stream import FrameAnswer
from mereo.deformation.samplers import RandomMotion
from mereo.fitting.problem.residuals import are_near
from mereo.fitting.tracking import SynchronousExecutor
from mereo.geometry.camera import Camera
from mereo.geometry.conventions import Range
from mereo.geometry.mesh_check import examine
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, rigid
from mereo.io.robots import is_robot, read_robot
from mereo.io.writers.meshes import write_positions_ply
from mereo.models.weights import save_model
from mereo.results.joints import JointValue
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.parameters import parameters, random_state, with_joints
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene, SourceFrame
from mereo.scenes.seeds import example_rng
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth
from mereo_viewer.result_page import content_of_answer, content_of_files

yourdfpy = pytest.importorskip("yourdfpy", reason="yourdfpy is not installed: pip install 'mereo[robot]'")

PAGE = Path(__file__).parents[2] / "docs/own-object.md"


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gripper(tmp_path_factory.mktemp("robots"))


def off_degrees(result: mereo.Result, true: list[float]) -> float:
    """Largest error of a joint, degrees."""
    return float(np.rad2deg(np.abs(np.subtract([joint.value for joint in result.joints.values()], true))).max())


def write_frame(
    path: Path, scene: Scene, shares: Sequence[float], seed: int, pixels: int = 128, seen_parts: int = 99
) -> list[float]:
    """Write the noisy depth cloud in metres of free joints at shares of their ranges; returns the values.

    Of segments after the first ``seen_parts`` nothing is seen.
    """
    motion = scene.sample_deformations
    assert isinstance(motion, RandomMotion) and scene.unit_m is not None
    leaders = [joint for joint, _ in motion.joints.values() if not joint.follows]
    given = {joint.name: share for joint, share in zip(leaders, shares, strict=True)}
    mesh = scene.deform(motion.at(given)).mesh
    rng = default_rng(seed)
    seen = mesh.transformed(inverse_rigid(scene.workspace.sample(rng, mesh.bounds.mean(axis=0))))
    image = add_depth_noise(render_depth(seen, Camera.from_fov(pixels, pixels, scene.workspace.fov_rad)), 0.1, rng)
    points = image.to_points().points
    points = points[Solids(seen).nearest(points).owner < seen_parts]
    write_positions_ply(path, points * scene.unit_m)
    values = [joint.limits[0] + share * np.ptp(joint.limits) for joint, share in zip(leaders, shares, strict=True)]
    return [float(value) * (1 if leaders[0].turns else scene.unit_m) for value in values]  # all turn, or all slide


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".urdf", ".sdf"])
def test_both_formats_give_links_in_metres_and_joints_by_name(gripper: Path, suffix: str) -> None:
    robot = read_robot(gripper.with_suffix(suffix))
    assert robot.mesh.names == ("palm", "left", "right")  # what is fixed is one segment
    bounds = [[[-0.05, -0.025, -0.055], [0.05, 0.025, 0.015]], [[-0.016, -0.015, 0.017], [0.017, 0.015, 0.077]]]
    for segment, expected in zip(robot.mesh.segments, bounds, strict=False):
        assert_allclose(segment.bounds, expected, atol=1e-9)
    assert min(segment.volume for segment in robot.mesh.segments) > 0  # the mirrored mesh faces outwards, too
    assert robot.mesh.segments[1].volume == pytest.approx(robot.mesh.segments[2].volume)
    follower, finger = robot.joints  # the last link first
    assert (finger.name, finger.turns, finger.moved, finger.follows) == ("finger", False, ("left",), "")
    assert (follower.name, follower.moved, follower.follows) == ("other finger", ("right",), "finger")
    assert_allclose([finger.pivot, finger.axis], [[-0.01, 0, 0.047], [-1, 0, 0]], atol=1e-12)
    assert_allclose([follower.pivot, follower.axis], [[0.01, 0, 0.047], [1, 0, 0]], atol=1e-12)
    assert_allclose([finger.limits, follower.limits], [[0.003, 0.035], [0.0035, 0.0195]], atol=1e-12)
    turned = [[0, -1, 0, 0.01], [1, 0, 0, 0], [0, 0, 1, 0.047], [0, 0, 0, 1]]
    assert_allclose(robot.link_frames["right"], turned, atol=1e-12)
    left_out = ("joint 'spin' is left out, for it moves no segment against others",)
    assert robot.notes == (left_out if suffix == ".urdf" else ())


def test_shapes_of_collisions_stand_in_where_none_are_visual(tmp_path: Path) -> None:
    for suffix, text in ((".urdf", LAPTOP.replace("visual", "collision")), (".sdf", LAPTOP_SDF)):
        path = tmp_path / f"laptop{suffix}"
        path.write_text(text)
        robot, (joint,) = read_robot(path), read_robot(path).joints
        assert robot.mesh.names == ("base", "lid") and joint.turns and joint.moved == ("lid",)
        assert_allclose([joint.pivot, joint.axis], [[0, -0.1, 0.016], [1, 0, 0]], atol=1e-9)
        assert_allclose(joint.limits, (0.3, 2.2))
        assert_allclose(robot.link_frames["lid"][:3, 3], [0, 0 if suffix == ".sdf" else -0.1, 0.016], atol=1e-12)
        low, high = robot.mesh.bounds
        assert_allclose([*low, *high[:2]], [-0.15, -0.1, -0.01, 0.15, 0.1], atol=1e-9)
        assert high[2] == pytest.approx(0.041, abs=1e-4)  # a round part that is joined to the lid
        path.write_text(text.replace("0.015", "0.0005"))
        assert all(examine(segment).sound for segment in read_robot(path).mesh.segments)  # however small


BALL = "<collision><geometry><sphere radius='0.4'/></geometry></collision></link>"


def test_a_link_has_the_meshes_that_are_named_or_else_the_others(tmp_path: Path) -> None:
    (base, lid), box, path = LAPTOP.split('<link name="lid">'), [0.3, 0.2, 0.02], tmp_path / "laptop.urdf"
    bare, both = base.replace("visual", "collision"), base.replace("</link>", BALL)
    for first, meshes, sides, lacking in (
        (bare, "visual", box, ["base"]),
        (both, "visual", box, []),
        (both, "collision", [0.8] * 3, ["lid"]),
    ):
        path.write_text(f'{first}<link name="lid">{lid}')
        robot = read_robot(path, meshes)
        assert_allclose(np.ptp(robot.mesh.segments[0].bounds, axis=0), sides, atol=2e-3)
        assert robot.notes == tuple(f"link {name!r} has no {meshes} shape, so its others are taken" for name in lacking)


def test_an_option_names_the_meshes_and_a_scene_file_keeps_it(
    working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    Path("laptop.urdf").write_text(LAPTOP.replace("</link>", BALL, 1))
    run_mereo("scene", "new", "laptop.urdf", "--robot-meshes", "collision")
    scene = mereo.load_object("laptop.urdf", robot_meshes="collision").scene
    assert_array_equal(load_scene("laptop.yaml").rest.merged()[0], scene.rest.merged()[0])
    assert np.ptp(scene.rest.bounds[:, 0]) * scene.unit_m == pytest.approx(0.8, abs=1e-3)
    assert run_mereo("scene", "new", "box.obj", "--robot-meshes", "collision") == 2
    assert "--robot-meshes is collision, but box.obj is no robot's file: leave it out" in capsys.readouterr().err


MJCF = """<mujoco><compiler angle="radian"/><worldbody><geom type="plane" size="1 1 .1"/>
<body name="palm" pos="0 0 .5"><freejoint/><geom type="box" size=".05 .02 .01"/><body name="left" pos="-.03 0 .01">
<joint name="finger" type="slide" axis="1 0 0" range="0 .02"/><geom type="capsule" size=".005 .04" pos="0 0 .04"/>
</body><body name="right" pos=".03 0 .01"><joint name="other" type="slide" axis="-1 0 0" range="0 .02"/>
<geom type="cylinder" size=".005 .04" pos="0 0 .04"/><geom type="mesh" mesh="tip" contype="0" conaffinity="0"/>
<body name="nail" pos="0 0 .085" euler="0 .2 0"><joint name="bend" axis="0 1 0" range="-.5 .5" ref=".2"/>
<joint name="twist" axis="0 0 1" range="-1 1"/><geom type="ellipsoid" size=".006 .007 .008"/></body></body></body>
</worldbody><asset><mesh name="tip" vertex="0 0 0  .01 0 0  0 .02 0  0 0 .03"/></asset>
<equality><joint joint1="other" joint2="finger" polycoef="0 .5 0 0 0"/></equality></mujoco>"""
"""A gripper with shapes of each kind, a finger that follows another, and a joint that is not zero where it is drawn."""


def test_a_simulators_robot_has_its_joints_at_zero(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed: pip install 'mereo[simulation]'")
    path = tmp_path / "gripper.xml"
    path.write_text(MJCF)
    robot = read_robot(path)
    assert is_robot(path) and robot.mesh.names == ("palm", "left", "right", "nail")
    bounds = [
        [[-0.05, -0.02, 0.49], [0.05, 0.02, 0.51]],
        [[-0.035, -0.005, 0.505], [-0.025, 0.005, 0.595]],
        [[0.03, 0, 0.51], [0.04, 0.02, 0.54]],  # what is drawn, without what collides
        [[0.024, -0.007, 0.587], [0.036, 0.007, 0.603]],  # .2 rad back
    ]
    for segment, expected in zip(robot.mesh.segments, bounds, strict=True):
        assert_allclose(segment.bounds, expected, atol=2e-4)
    assert_allclose(
        read_robot(path, "collision").mesh.segments[2].bounds, [[0.025, -0.005, 0.51], [0.035, 0.005, 0.59]]
    )
    joints = {joint.name: joint for joint in robot.joints}
    assert {name: joint.moved for name, joint in joints.items()} == {
        "finger": ("left",), "other": ("right", "nail"), "bend": ("nail",), "twist": ("nail",)
    }  # fmt: skip
    assert joints["other"].follows == "finger" and not joints["other"].turns and joints["bend"].turns
    assert_allclose(joints["other"].limits, [0, 0.01])
    assert_allclose([joints["twist"].pivot, joints["twist"].axis], [[0.03, 0, 0.595], [0, 0, 1]], atol=1e-9)
    assert_allclose(joints["bend"].limits, [-0.5, 0.5])
    assert_allclose(robot.link_frames["nail"], rigid(np.eye(3), np.array([0.03, 0, 0.595])), atol=1e-9)
    for old, new, message in (
        (
            '<joint name="finger"',
            '<joint name="ball" type="ball"/><joint name="finger"',
            "joint 'ball' turns or moves freely",
        ),
        ("</worldbody>", '<body><freejoint/><geom size=".1"/></body></worldbody>', "turns or moves freely"),
        ("<freejoint/>", "<motor/>", "cannot be read as a robot in MJCF"),
    ):
        path.write_text(MJCF.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_robot(path)
    path.write_text("<package/>")
    assert not is_robot(path), "as of ROS"


WEDGE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.001" name="millimeter"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="wedge"><mesh>
<source id="at"><float_array id="at-array" count="12">0 0 0 100 0 0 0 200 0 0 0 300</float_array>
<technique_common><accessor source="#at-array" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="of"><input semantic="POSITION" source="#at"/></vertices>
<triangles count="2"><input semantic="VERTEX" source="#of" offset="0"/><p>0 2 1 0 1 3</p></triangles>
<triangles count="2"><input semantic="VERTEX" source="#of" offset="0"/><p>0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="n"><translate>0 0 50</translate>
<node id="m"><instance_geometry url="#wedge"/></node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""
"""A tetrahedron in millimetres, in two materials, with y up and a node that is shifted."""


def test_meshes_of_collada_are_as_rviz_shows_them(tmp_path: Path) -> None:
    """In metres by their unit, whichever axis they say is up, and scaled as the robot's file says."""
    (tmp_path / "wedge.dae").write_text(WEDGE)
    path = tmp_path / "laptop.urdf"
    mesh = '<mesh filename="wedge.dae" scale="1 1 2"/>'
    path.write_text(LAPTOP.replace('<box size="0.3 0.2 0.02"/>', mesh))
    base = read_robot(path).mesh.segments[0]
    assert_allclose(base.bounds, [[0, 0, 0.1], [0.1, 0.2, 0.7]], atol=1e-9)
    assert len(base.vertices) == 4 and base.volume == pytest.approx(0.002)  # the materials together are closed
    (tmp_path / "wedge.dae").write_text(WEDGE.replace('<unit meter="0.001" name="millimeter"/>', ""))
    assert_allclose(read_robot(path).mesh.segments[0].bounds, [[0, 0, 100], [100, 200, 700]], atol=1e-9)
    (tmp_path / "wedge.dae").write_text(WEDGE.replace("#wedge", "#edge"))
    with pytest.raises(ValueError, match=r"wedge.dae cannot be read as a mesh \(.*edge.*\): export or download"):
        read_robot(path)


def test_a_scene_file_has_the_joints_and_one_number_moves_both_fingers(
    gripper: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "gripper.yaml"
    assert not run_mereo("scene", "new", gripper, "--output", path)
    text = capsys.readouterr().out
    assert "deformations: by its joints, as the file says" in text and "links may" in text and "'spin'" in text
    scene = load_scene(path)
    assert scene.unit_m is not None and np.ptp(scene.rest.bounds[:, 0]) * scene.unit_m == pytest.approx(0.1)
    (slider,) = parameters(random_state(scene, 0))
    assert (slider.group, slider.name) == ("finger", "slide")
    motion = scene.sample_deformations
    rng = example_rng(0, 0)
    assert isinstance(motion, RandomMotion)
    palm, left, right = (deform(np.zeros((1, 3)))[0] * scene.unit_m for deform in motion(rng))
    assert 0.003 < -left[0] < 0.035 and right[0] == pytest.approx(-0.5 * left[0] + 0.002)
    assert_allclose([*palm, *left[1:], *right[1:]], 0.0, atol=1e-12)
    assert not run_mereo("scene", "check", path)  # links that overlap are no fault
    assert "note: left and right overlap" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::mereo.io.mesh_formats.MeshWarning")
def test_shells_of_a_link_that_overlap_are_no_fault_and_a_repair_unites_them(
    working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    trimesh.util.concatenate([box((0.3, 0.2, 0.02)), box((0.1, 0.1, 0.05))]).export("base.stl")
    Path("laptop.urdf").write_text(LAPTOP.replace('<box size="0.3 0.2 0.02"/>', '<mesh filename="base.stl"/>'))
    run_mereo("scene", "new", "laptop.urdf")
    assert not run_mereo("scene", "check", "laptop.yaml")
    assert "note: it intersects itself" in capsys.readouterr().out
    run_mereo("scene", "check", "laptop.yaml", "--repair")
    assert "repaired base: united 2 shells that overlap" in capsys.readouterr().out
    before, after = (load_scene(f"laptop{end}.yaml").link_frames for end in ("", "-repaired"))
    assert_array_equal([*after.values()], [*before.values()])
    text = Path("laptop-repaired.yaml").read_text()
    Path("bad.yaml").write_text(text.replace("- [1.0, 0.0, 0.0, 0.0]", "- [2.0, 0.0, 0.0, 0.0]", 1))
    with pytest.raises(ValueError, match=r"bad.yaml:10: `frame` is .*; it must be 4 x 4 numbers"):
        load_scene("bad.yaml")


def test_joints_without_names_draw_as_before_and_names_are_checked(tmp_path: Path, gripper: Path) -> None:
    path = tmp_path / "gripper.yaml"
    run_mereo("scene", "new", gripper, "--output", path)
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
    path = tmp_path / ("laptop.urdf.xacro" if message == "macro file" else "laptop.urdf")
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


@pytest.mark.skipif(not SALAMANDER.is_file(), reason="MEREO_ASSETS holds no lizard/salamander.sdf")
def test_a_real_file_of_gazebo_loads_with_its_capsules_of_a_millimetre() -> None:
    robot = read_robot(SALAMANDER)
    assert len(robot.mesh.names) == 25 and len(robot.joints) == 30 and robot.notes == ()
    assert all(examine(segment).sound for segment in robot.mesh.segments)
    assert_allclose(np.ptp(robot.mesh.bounds, axis=0), [0.1003, 0.0324, 0.0081], atol=1e-4)
    limits = {joint.name: joint.limits for joint in robot.joints}
    assert_allclose([limits["joint_body_0"], limits["joint_leg_1_R_3"]], [[-pi / 2, pi / 2], [-pi, pi]], atol=1e-6)


needs_arm = pytest.mark.skipif(not ARM.is_file(), reason="MEREO_ASSETS holds no robot/so101_new_calib.urdf")


@needs_arm
@pytest.mark.filterwarnings("ignore::mereo.io.mesh_formats.MeshWarning")
def test_a_real_arm_loads_with_its_links_joints_and_limits(tmp_path: Path) -> None:
    robot = read_robot(write_arm(tmp_path / "arm.urdf"))
    links = ("base", "shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "moving_jaw_so101_v1")
    assert robot.mesh.names == tuple(f"{link}_link" for link in links) and robot.notes == ()
    assert_allclose(np.ptp(robot.mesh.bounds, axis=0), [0.4295, 0.1109, 0.2681], atol=1e-4)
    degrees = {joint.name: np.rad2deg(joint.limits).round().tolist() for joint in robot.joints}
    assert degrees == {
        "gripper": [-10, 100], "wrist_roll": [-157, 163], "wrist_flex": [-95, 95], "elbow_flex": [-97, 97],
        "shoulder_lift": [-100, 100], "shoulder_pan": [-110, 110],
    }  # fmt: skip
    assert [len(joint.moved) for joint in robot.joints] == [1, 2, 3, 4, 5, 6]
    run_mereo("scene", "new", tmp_path / "arm.urdf", "--output", tmp_path / "arm.yaml")
    assert not run_mereo("scene", "check", tmp_path / "arm.yaml")  # links of motors and brackets


# --- frames -----------------------------------------------------------------------------------------------------------


def assert_kinematics(path: Path, result: mereo.Result, link: str, base: str) -> None:
    """Assert that the pose of a link in another one is what the file says of the values that were found."""
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    robot.update_cfg({name: result.joints[name].value for name in robot.actuated_joint_names if name in result.joints})
    assert_allclose(result[link].pose_in(base), robot.get_transform(link, base), atol=1e-6)


def test_the_angle_of_a_hinge_is_found_with_its_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "laptop.urdf").write_text(LAPTOP)
    laptop = mereo.load_object(tmp_path)  # the folder of a robot's file
    assert laptop.scene is not None
    (true,) = write_frame(tmp_path / "frame.ply", laptop.scene, [0.6], 0)
    assert true == pytest.approx(0.3 + 0.6 * 1.9)  # the file's angle, although its rest pose is closed
    result = mereo.reconstruct(tmp_path / "frame.ply", laptop, unit_m=1.0)
    joint = result.joints["hinge"]
    monkeypatch.delattr("mereo.results.joints.least_squares")  # they are measured once
    facts = FrameAnswer.of(result).facts  # what a line of a stream has
    assert facts["joints"] == {"hinge": joint.facts()}
    assert_allclose(facts["segments"]["lid"]["pose"], result["lid"].pose, atol=1e-6)
    assert_kinematics(tmp_path / "laptop.urdf", result, "lid", "base")
    stored = pickle.loads(pickle.dumps(result))
    assert stored.joints == result.joints
    assert joint.interval is not None and joint.interval[0] < true < joint.interval[1]
    assert abs(np.rad2deg(joint.value - true)) < 1.0 and joint.unit == "rad"
    assert_allclose(joint.limits, (0.3, 2.2))
    assert re.fullmatch(r"82\.\d+° \(82\.\d+ to 82\.\d+\)", str(joint))
    folder = result.save(tmp_path / "result")
    cells = f"hinge</td><td style=.*>{re.escape(str(joint))}<"
    for page in (result._repr_html_(), content_of_answer(result).joints, content_of_files(folder).joints):
        assert len(re.findall(cells, page)) == 1, "as in the report, from which the last one is"


@needs_arm
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mereo.io.mesh_formats.MeshWarning")
def test_the_joints_of_a_real_arm_are_within_a_degree(tmp_path: Path) -> None:
    arm = mereo.load_object(write_arm(tmp_path / "arm.urdf"))
    assert arm.scene is not None
    true = write_frame(tmp_path / "frame.ply", arm.scene, default_rng(2).uniform(0.1, 0.9, 6).tolist(), 2, 192)
    result = mereo.reconstruct(tmp_path / "frame.ply", arm, unit_m=1.0)
    assert result.known is True and off_degrees(result, true) < 1.0


def test_the_commands_of_the_page_give_the_joints_of_a_gripper(
    gripper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(gripper.parent)
    (true,) = write_frame(Path("frame.ply"), scene_of_meshes([Path("gripper.urdf")]), [0.5], 2)
    section = tmp_path / "section.md"
    section.write_text(PAGE.read_text().partition("## From a URDF or SDF")[2].partition("\n## ")[0])
    (commands,), (code,) = blocks(section, "bash"), blocks(section, "python")
    for line in commands.splitlines():
        command_line.main(line.partition("#")[0].split()[1:])
    printed = capsys.readouterr().out
    facts = read_json(Path("result/summary.json"))["joints"]
    assert set(facts) == {"finger", "other finger"} and facts["finger"]["unit"] == "m"
    for name, expected in (("finger", true), ("other finger", 0.5 * true + 0.002)):
        assert facts[name]["value"] == pytest.approx(expected, abs=0.001)
        assert facts[name]["interval"][0] < expected < facts[name]["interval"][1]
        value, (least, most) = facts[name]["value"], facts[name]["interval"]
        assert f"joint {name}: {JointValue(value, (least, most), 'm', (0.0, 1.0))}" in printed
    variables = {}
    exec(compile(code, "own-object.md", "exec"), variables)
    result = variables["result"]
    assert isinstance(result, mereo.Result)
    assert result.joints["finger"].value == pytest.approx(facts["finger"]["value"], abs=1e-6)
    assert_kinematics(Path("gripper.urdf"), result, "right", "palm")
    assert_allclose(mereo.load_result("result")["right"].pose, result["right"].pose, atol=1e-6)
    frame = load_scene("gripper.yaml").source_frame  # which the page's command has written
    assert_allclose(SourceFrame.of_facts(frame.facts()).link_frames["right"][:3, 3], [0.01, 0, 0.047])
    assert scene_of_meshes([Path("../meshes/palm.stl")]).link_frames == {}
    assert isinstance(held := variables["held"], mereo.Result) and held.known is True
    assert held.joints["finger"].interval == pytest.approx((true, true), abs=1e-12)


def test_each_frame_of_a_stream_has_the_joints_of_its_moment(
    gripper: Path, working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    Path("frames").mkdir()
    scene = scene_of_meshes([gripper])
    true = [write_frame(Path(f"frames/{i}.ply"), scene, [0.4 + 0.03 * i], 5)[0] for i in range(6)]
    run_mereo("stream", "frames", "--object", gripper, "--unit-m", "1", "--every-frame")
    lines = [*map(json.loads, capsys.readouterr().out.splitlines())]
    assert [line["tracking"] for line in lines] == ["found", *["followed"] * 5]
    fingers = [[line["joints"][name]["value"] for line in lines] for name in ("finger", "other finger")]
    assert_allclose(fingers, [true, 0.5 * np.array(true) + 0.002], atol=2e-4)


# --- joints whose values are known ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def known(gripper: Path) -> mereo.Object:
    return mereo.load_object(gripper)


def given_shares(known: mereo.Object, given: object) -> Range:
    """Shares of the range of the gripper's finger that are left, of which both fingers' random states are."""
    narrowed = known.with_joints(given)
    assert narrowed.scene is not None and known.scene is not None
    motion = narrowed.scene.sample_deformations
    assert isinstance(motion, RandomMotion)
    shares = motion.joints["finger"][0].shares
    places = np.array([[each(np.zeros((1, 3)))[0, 0] for each in motion(example_rng(0, i))] for i in range(50)])
    ends = np.array([[each(np.zeros((1, 3)))[0, 0] for each in motion.at({"finger": share})] for share in shares])
    assert (places >= ends.min(axis=0) - 1e-9).all() and (places <= ends.max(axis=0) + 1e-9).all()
    assert (np.ptp(places, axis=0) >= 0.8 * np.ptp(ends, axis=0)).all()
    return shares


def test_known_values_narrow_the_random_states_whoever_states_them(known: mereo.Object, tmp_path: Path) -> None:
    share = pytest.approx((0.017 / 0.032, 0.017 / 0.032))
    state = {"name": ["wheel", "finger", "other finger"], "position": np.array([3.0, 0.02, 0.012])}
    for given in (
        {"finger": 0.02},
        {"other finger": 0.012},
        state,
        SimpleNamespace(**state),
        {"finger": JointValue(np.float64(0.02), None, "m", (0, 1))},
    ):
        assert given_shares(known, given) == share
    (tmp_path / "joints.json").write_text('{"finger": {"value": 0.02, "within": 0.0}}')
    (tmp_path / "state.yaml").write_text(  # what `ros2 topic echo --once /joint_states` prints
        "header:\n  stamp:\n    sec: 5\n  frame_id: ''\nname:\n- finger\n- wheel\nposition:\n- 0.02\n- 1.0e-05\n"
        "velocity: []\neffort: []\n---\n"
    )
    for file in ("joints.json", "state.yaml"):
        assert given_shares(known, tmp_path / file) == share == given_shares(known, str(tmp_path / file))
    within = {"value": 0.005, "within": 0.008}  # as far as the limits go
    assert given_shares(known, {"finger": within}) == pytest.approx((0.0, 0.01 / 0.032))
    both = {"finger": within, "other finger": {"value": 0.006, "within": 0.001}}
    assert given_shares(known, both) == pytest.approx((0.003 / 0.032, 0.007 / 0.032))
    assert (fixed := known.with_joints({"finger": 0.02})) is known.with_joints(state)  # made once
    assert fixed.model is not None and not are_near(fixed.model)


def test_a_value_that_is_given_twice_is_one_value(known: mereo.Object, tmp_path: Path) -> None:
    within = known.with_joints({"finger": {"value": 0.02, "within": 0.004}})
    assert given_shares(within, {"finger": 0.022}) == pytest.approx((0.019 / 0.032,) * 2)
    assert given_shares(within, {"finger": {"value": 0.03, "within": 0.01}}) == pytest.approx(
        (0.017 / 0.032, 0.021 / 0.032)
    )
    fixed = known.with_joints({"finger": 0.02})
    (true,) = write_frame(tmp_path / "frame.ply", known.scene, [0.017 / 0.032], 5)
    sentence = "joint '%s' is %s, which contradicts what was given before, with the object: leave one of both out"
    with mereo.Tracker(fixed) as tracker:
        for time_s, joints in enumerate(({"finger": true}, {"other finger": 0.012})):
            assert tracker.follow(tmp_path / "frame.ply", time_s, unit_m=1.0, joints=joints).known is True
        for name, value in (("finger", 0.021), ("other finger", 0.011)):
            with pytest.raises(ValueError, match=sentence % (name, value)):
                tracker.follow(tmp_path / "frame.ply", 9.0, unit_m=1.0, joints={name: value})


def test_a_joint_of_a_whole_turn_goes_on_beyond_its_limits(tmp_path: Path) -> None:
    (tmp_path / "laptop.urdf").write_text(LAPTOP.replace("revolute", "continuous"))
    laptop = mereo.load_object(tmp_path / "laptop.urdf")
    for value in (3.1 - 2 * pi, 3.1 + 4 * pi):
        scene = laptop.with_joints({"hinge": {"value": value, "within": 0.1}}).scene
        assert scene is not None and isinstance(scene.sample_deformations, RandomMotion)
        shares = np.array(scene.sample_deformations.joints["hinge"][0].shares)
        assert_allclose((2 * pi * shares - pi) % (2 * pi), [3.0, 3.2], atol=1e-9)
        turned = with_joints(scene, {"hinge": -3.13}).sample_deformations  # the same angle on the other side of a turn
        assert_allclose((2 * pi * np.array(turned.joints["hinge"][0].shares) - pi) % (2 * pi), 2 * pi - 3.13)
        with pytest.raises(ValueError, match="joint 'hinge' is 0, which contradicts what was given before"):
            with_joints(scene, {"hinge": 0.0})


NO_JOINTS = {
    "no joint is called 'fingr'; it must be one of other finger, finger: correct it": {"fingr": 0.02},
    "joint 'finger' is 0.05; its limits are 0.003 to 0.035 m: give metres, correct it, or add `within`": {
        "finger": 0.05
    },
    "joint 'finger' is 'open'; it must be a finite number: give for example 0.1": {"finger": "open"},
    "joint 'finger' is nan; it must be a finite number": {"finger": float("nan")},
    "joint 'finger' is True; it must be a finite number": {"finger": True},
    "`within` of joint 'finger' is -0.1; it must be at least 0: give": {"finger": {"value": 0.02, "within": -0.1}},
    "joint 'finger' is {'value': 0.02, 'std': 0.1}; it must be a number, or `value` and `within`, its": {
        "finger": {"value": 0.02, "std": 0.1}
    },
    "joint 'other finger' is 0.01, which contradicts others that move with it: give 'finger' alone": {
        "finger": 0.02,
        "other finger": 0.01,
    },
    "`name` is ['finger'] and `position` [0.0, 0.1]; they must be lists of one length: correct them": {
        "name": ["finger"],
        "position": [0.0, 0.1],
    },
    "`name` is 'finger' and `position` 0.02; they must be lists": {"name": "finger", "position": 0.02},
    "the joints are {}; they must be values by name, of other finger, finger: give": {"name": ["a"], "position": [0.0]},
    "the joints are 0.02; they must be values by name": 0.02,
}


@pytest.mark.parametrize("message", NO_JOINTS)
def test_values_that_cannot_be_are_one_sentence(message: str, known: mereo.Object, tmp_path: Path) -> None:
    given = NO_JOINTS[message]
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        mereo.reconstruct(np.ones((500, 3)), known, joints=given)
    if isinstance(given, dict):
        (tmp_path / "joints.yaml").write_text(yaml.safe_dump(given, sort_keys=False))
        with pytest.raises(ValueError, match=re.escape(f"joints.yaml: {message}")):
            known.with_joints(tmp_path / "joints.yaml")


def test_objects_without_named_joints_files_of_other_things_and_a_network_alone_are_refused(
    gripper: Path, working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    palm = mereo.load_object(gripper.parents[1] / "meshes/palm.stl", units="mm", deformations="rigid")
    with pytest.raises(ValueError, match="joints are given, but the object has none with a name: leave them out, or"):
        mereo.Tracker(palm, joints={"finger": 0.02})
    Path("frames").mkdir()
    write_positions_ply(Path("frames/frame.ply"), default_rng(0).normal(size=(500, 3)))
    save_model(untrained(("palm", "left", "right")), Path("mine.safetensors"))
    options = "--object", gripper, "--weights", "mine.safetensors", "--method", "network", "--joints"
    for name, text, sentence in (
        ("list.yaml", "- 0.02", "list.yaml holds no `key: value` lines; a file of joints starts with `JOINT:`"),
        ("bad.yaml", "finger: [0.02", "bad.yaml:1: this is not YAML"),
        ("bad joint.yaml", "finger: 1", "bad joint.yaml: joint 'finger' is 1; its limits are 0.003 to 0.035 m"),
        ("joint.yaml", "finger: 0.02", "values of joints are given, but the method is network, and a network alone"),
    ):
        Path(name).write_text(text)
        for command in (["reconstruct", "frames/frame.ply", "--output", "result"], ["stream", "frames"]):
            assert run_mereo(*command, *options, name) == 2
            assert sentence in capsys.readouterr().err
    assert run_mereo("stream", "frames", *options, ".") == 2 and sentence in capsys.readouterr().err, "of each frame"
    assert not Path("result").exists()


def test_only_the_rest_of_a_gripper_with_known_joints_is_looked_for(
    known: mereo.Object,
    gripper: Path,
    working_folder: Path,
    capsys: pytest.CaptureFixture,
) -> None:
    assert known.scene is not None
    (true,) = write_frame(Path("frame.ply"), known.scene, [0.4], 5)
    free, fixed = (mereo.reconstruct("frame.ply", known, unit_m=1.0, joints=j) for j in (None, {"finger": true}))
    joints = fixed.joints
    assert joints["finger"].value == pytest.approx(true, abs=1e-12) and fixed.known is True
    assert joints["finger"].interval == pytest.approx((true, true), abs=1e-12)
    assert joints["other finger"].value == pytest.approx(0.5 * true + 0.002, abs=1e-12)
    assert "(" not in str(joints["finger"])
    assert_allclose(joints["finger"].limits, [0.003, 0.035])
    assert_allclose(fixed["left"].mesh.vertices, free["left"].mesh.vertices, atol=3e-4)
    Path("joints.yaml").write_text(f"finger: {{value: {true + 0.002}, within: 0.003}}\n")
    options = ["--object", str(gripper), "--unit-m", "1", "--joints", "joints.yaml"]
    run_mereo("reconstruct", "frame.ply", *options, "--output", "result")
    assert "joint finger: " in capsys.readouterr().out
    facts = read_json(Path("result/summary.json"))["joints"]["finger"]
    assert true - 0.001 <= facts["interval"][0] <= true <= facts["interval"][1] <= true + 0.005
    assert facts["value"] == pytest.approx(true, abs=3e-4)
    assert read_json(Path("result/config.json"))["joints"] == str(working_folder / "joints.yaml")


@pytest.mark.slow  # as nothing explains the frame, the search tries all it has
def test_a_frame_that_contradicts_a_known_value_is_not_believed(known: mereo.Object, tmp_path: Path) -> None:
    assert known.scene is not None
    (true,) = write_frame(tmp_path / "frame.ply", known.scene, [0.4], 5)
    result = mereo.reconstruct(tmp_path / "frame.ply", known, unit_m=1.0, joints={"finger": true + 0.01})
    assert result.known is False and result.joints["finger"].value == pytest.approx(true + 0.01, abs=1e-12)


def test_fingers_that_nothing_shows_are_where_the_encoder_says_in_each_frame(
    known: mereo.Object, tmp_path: Path
) -> None:
    """Followed from the last frame's state, and found again by a search."""
    assert known.scene is not None and known.joints == ("other finger", "finger")
    frame = tmp_path / "frame.ply"
    times = (0.0, 0.1, 0.2, 0.3, 99.0)
    with mereo.Tracker(known, executor=SynchronousExecutor()) as tracker:
        for time_s, share, seen_parts in zip(times, (0.2, 0.4, 0.6, 0.8, 0.1), (3, 1, 1, 3, 3), strict=True):
            (true,) = write_frame(frame, known.scene, [share], 5, seen_parts=seen_parts)
            result = tracker.follow(
                frame, time_s, unit_m=1.0, extent="partial", joints={"finger": {"value": true, "within": 1e-6}}
            )
            assert result.tracking == ("followed" if 0 < time_s < 1 else "found") and result.known is True
            assert result.joints["finger"].interval == pytest.approx((true, true), abs=2e-6)
            for name, x in (("left", -0.01 - true), ("right", 0.01 + 0.5 * true + 0.002)):
                assert_allclose(result[name].pose_in("palm")[:3, 3], [x, 0, 0.047], atol=2e-4)
        (true,) = write_frame(frame, known.scene, [0.3], 5, seen_parts=1)
        unseen = tracker.follow(frame, 99.1, unit_m=1.0, extent="partial").joints["finger"]
    assert unseen.interval is not None and np.ptp(unseen.interval) > 0.002, "of which nothing is given"


def test_a_lamp_whose_joints_are_known_is_followed_without_bending(working_folder: Path) -> None:
    Path("lamp.urdf").write_text(LAMP)
    lamp = mereo.load_object("lamp.urdf", deformations="rigid")  # with joints all the same
    with mereo.Tracker(lamp) as tracker:
        for step in range(3):
            true = write_frame(Path("frame.ply"), lamp.scene, [0.2 + 0.05 * step] * 3, 5)
            joints = dict(zip(lamp.joints, true, strict=True))
            result = tracker.follow("frame.ply", 0.1 * step, unit_m=1.0, joints=joints)
    assert result.tracking == "followed"
    assert_kinematics(Path("lamp.urdf"), result, "head", "foot")


def test_a_lamp_of_which_nothing_is_known_is_followed_without_bending(working_folder: Path) -> None:
    Path("lamp.urdf").write_text(LAMP)
    lamp = mereo.load_object("lamp.urdf")
    with mereo.Tracker(lamp) as tracker:
        for step in range(4):
            true = write_frame(Path("frame.ply"), lamp.scene, [0.2 + 0.02 * step, 0.7, 0.4 + 0.02 * step], 5)
            result = tracker.follow("frame.ply", 0.1 * step, unit_m=1.0)
            assert result.known is True and off_degrees(result, true) < 1.0
            for joint, value in zip(result.joints.values(), true, strict=True):
                assert joint.interval[0] < value < joint.interval[1]
    assert result.tracking == "followed"
    assert_kinematics(Path("lamp.urdf"), result, "head", "foot")


def test_a_pose_that_is_given_leaves_the_joints_to_be_looked_for(working_folder: Path) -> None:
    Path("lamp.urdf").write_text(LAMP)
    lamp = mereo.load_object("lamp.urdf")
    true = write_frame(Path("frame.ply"), lamp.scene, [0.3, 0.75, 0.3], 5)
    pose = mereo.reconstruct("frame.ply", lamp, unit_m=1.0).pose
    pose[:3, 3] += 0.01
    result = mereo.reconstruct("frame.ply", lamp, unit_m=1.0, initial_pose=pose)
    assert result.located_by == "pose" and result.known is True
    assert off_degrees(result, true) < 1.0


def test_a_stream_reads_the_joints_of_each_frame_from_a_folder_or_a_recording(
    known: mereo.Object, gripper: Path, working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    bags = pytest.importorskip("recorded_bags", reason="rosbags comes with the extra sensors")
    for folder in ("frames", "joints"):
        Path(folder).mkdir()
    assert known.scene is not None
    true = [write_frame(Path(f"frames/{i}.ply"), known.scene, [0.4 + 0.1 * i], 5)[0] for i in range(3)]
    for i in (0, 2):
        Path(f"joints/{i}.yaml").write_text(f"finger: {true[i]}")
    points = trimesh.load("frames/0.ply").vertices

    def topics(make: Any) -> Any:
        states = [make.joints(["wheel", "finger"], [1.0, true[0]])]
        return {"/points": [make.cloud(points[len(points) % 2 :])] * 3, "/joint_states": states}

    bag = bags.write_bag(Path("robot.mcap"), 2, topics)
    options = ("--object", gripper, "--every-frame", "--joints")
    run_mereo("stream", "frames", *options, "joints", "--unit-m", "1")
    run_mereo("stream", bag, *options, "/joint_states")
    lines = [*map(json.loads, capsys.readouterr().out.splitlines())]
    assert lines.pop(1)["error"] == "joints/1.yaml does not exist; a file of joints is needed: check the path"
    del lines[2]  # the recording's first frame is as early as the values
    intervals = [line["joints"]["finger"]["interval"] for line in lines]
    assert_allclose(intervals, np.repeat([[true[i]] for i in (0, 2, 0, 0)], 2, axis=1), atol=1e-6)
    assert run_mereo("stream", bag, *options, "/wheels") == 2
    sentence = "has no joint states on topic '/wheels'; those it has are on: /joint_states"
    assert sentence in capsys.readouterr().err
