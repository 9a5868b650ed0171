"""Robots of URDF and SDF files: their links as segments where all joints are zero, and the joints that move them.

file -_read_urdf, _read_sdf-> _Tree -read_robot-> Robot

Links that no joint moves against each other are one segment. Lengths are metres and angles radians, as both formats
have them; positions are in the frame of the base, or of the SDF file's model.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.geometry.brief import listed
from mereo.geometry.conventions import LARGEST
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.mesh_check import united
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.errors import readable
from mereo.io.extras import library
from mereo.io.mesh_formats import ROBOT_SUFFIXES, read_object_mesh

FULL_TURN = (-np.pi, np.pi)
"""Range of a joint that turns without limits, or by more than a turn."""

MOVING = {"revolute": True, "continuous": True, "prismatic": False}
"""Kinds of joints that move a link, and whether they turn it."""

KINDS = (*MOVING, "fixed")

Matrix = Float[np.ndarray, "4 4"]
Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class RobotJoint:
    """Joint of a robot.

    Attributes:
        name: in the file.
        turns: whether it turns about ``axis``, else it slides along it.
        pivot, axis: point of the axis and its unit vector, where all joints are zero.
        limits: least and greatest value; of a joint that follows another one, its values where that is at its least
            and greatest, in either order.
        moved: names of the segments that it moves.
        follows: name of the joint that it mimics; "" of one with a value of its own.
    """

    name: str
    turns: bool
    pivot: Vector
    axis: Vector
    limits: tuple[float, float]
    moved: tuple[str, ...]
    follows: str = ""


@dataclass(frozen=True, eq=False)
class Robot:
    """Robot of a file.

    Attributes:
        mesh: a segment for each link that moves, with all links fixed to it, called after the first of them that has a
            shape; where all joints are zero.
        joints: those that move some of the segments against others, the tip of each chain first.
        notes: sentences about joints that are left out.
    """

    mesh: SegmentedMesh
    joints: tuple[RobotJoint, ...]
    notes: tuple[str, ...]


def is_robot(path: Path) -> bool:
    """Whether a path names a URDF or SDF file."""
    return path.suffix.lower() in ROBOT_SUFFIXES


def read_robot(path: str | Path) -> Robot:
    """Read a robot from a URDF or SDF file, with the meshes that it names.

    Shapes are those of the visual elements, where the file has any, else of the collision elements: meshes (with their
    scale), boxes, cylinders and spheres. ``package://NAME/...`` and ``model://NAME/...`` are looked for in the folders
    above the file.

    Raises ``FileNotFoundError`` for a missing file or mesh; ``ValueError`` for a damaged file, a joint that is neither
    revolute, continuous, prismatic nor fixed, links that form no tree, and a robot without shapes; ``ImportError``
    without the extra `robot`.
    """
    path = Path(path)
    tree = (_read_urdf if path.suffix.lower() == ".urdf" else _read_sdf)(path)
    files = sorted({shape.file for shapes in tree.shapes.values() for shape in shapes if shape.file is not None})
    states = [(str(file), file.stat()) for file in (path, *files)]
    known = tuple((name, state.st_ino, state.st_size, state.st_mtime_ns) for name, state in states)
    return _assembled(_Known(tree, known))


# --- links and joints of a file ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Shape:
    """Shape of a link: a solid, or a mesh's ``file`` in its own frame, scaled and then moved by ``T_robot_shape``."""

    T_robot_shape: Matrix
    solid: trimesh.Trimesh | None = None
    file: Path | None = None
    scale: Vector = field(default_factory=lambda: np.ones(3))

    def pieces(self) -> Iterable[tuple[np.ndarray, np.ndarray]]:
        """Vertices and faces of the shape's parts in the robot's frame."""
        if self.file is None:
            assert self.solid is not None
            parts: Sequence[Any] = [self.solid]
        else:
            parts = read_object_mesh(self.file).segments
        turn = -1 if np.prod(self.scale) < 0 else 1  # a mirrored surface faces inwards
        for part in parts:
            vertices = transform_points(self.T_robot_shape, np.asarray(part.vertices) * self.scale)
            yield vertices, np.asarray(part.faces, dtype=np.int64)[:, ::turn]


@dataclass(frozen=True, eq=False)
class _Joint:
    """Joint of a file; ``T_robot_joint`` is its frame, in which ``axis`` is given, ``mimic`` leader, factor, offset."""

    name: str
    kind: str
    parent: str
    child: str
    T_robot_joint: Matrix
    axis: Vector
    limits: tuple[float | None, float | None]
    mimic: tuple[str, float, float] | None = None


@dataclass(frozen=True, eq=False)
class _Tree:
    """Links of a file with their shapes, from the base on, and the joints between them in the same order."""

    path: Path
    shapes: Mapping[str, Sequence[_Shape]]
    joints: Sequence[_Joint]


@dataclass(frozen=True)
class _Known:
    """Content of a file, with the states on the disk of all files that it comes from."""

    tree: _Tree = field(compare=False)
    states: tuple[tuple[str, int, int, int], ...]


def _parsed(path: Path, tag: str, kind: str) -> Any:
    """Root of an XML file, which is ``tag``; entities are not resolved, and nothing else is opened."""
    etree = library("lxml.etree", "robot", path)
    with readable(path, kind):
        parser = etree.XMLParser(resolve_entities=False, remove_comments=True, remove_pis=True)
        root = etree.parse(BytesIO(path.read_bytes()), parser).getroot()
        if root.tag != tag:
            raise ValueError(f"its first element is <{root.tag}>, not <{tag}>")
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise ValueError(f"{path} is a macro file; its links are known once it is expanded: run `xacro` on it first")
    return root


def _checked_tree(path: Path, links: Sequence[str], ends: Sequence[tuple[str, str, str]]) -> list[int]:
    """Indices of joints (name, parent, child), each after those that carry it; ``ValueError`` where they are no tree."""
    for kind, names in (("links", links), ("joints", [name for name, _, _ in ends])):
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            raise ValueError(f"{path}: two {kind} are called {twice[0]!r}; names tell them apart: rename one of them")
    above = dict[str, str]()
    for name, parent, child in ends:
        for link in (parent, child):
            if link not in links:
                raise ValueError(f"{path}: joint {name!r} names the link {link!r}, which is not in the file: correct it")
        if child in above:
            raise ValueError(
                f"{path}: link {child!r} is carried by the joints {above[child]!r} and {name!r}; each link is carried "
                "by one, for loops are not known: leave one of them out"
            )
        above[child] = name
    roots = [link for link in links if link not in above]
    reached, order = set(roots[:1]), list[int]()
    while new := [k for k, (_, parent, _) in enumerate(ends) if parent in reached and k not in order]:
        order += new
        reached |= {ends[k][2] for k in new}
    if lost := [link for link in links if link not in reached]:
        base = f"the base {roots[0]!r}" if roots else "any base, as the joints form a loop"
        raise ValueError(f"{path}: no joint leads from {base} to the link {lost[0]!r}: add one, or leave the link out")
    return order


def _read_urdf(path: Path) -> _Tree:
    root = _parsed(path, "robot", "URDF file")
    yourdfpy, etree = library("yourdfpy", "robot", path), library("lxml.etree", "robot", path)
    with readable(path, "URDF file"):
        for joint in root.iterfind("joint"):  # what the library does not look at
            for part in ("parent", "child"):
                if joint.find(part) is None:
                    raise ValueError(f"its joint {joint.get('name')!r} has no <{part}>")
        content = BytesIO(etree.tostring(root))
        robot = yourdfpy.URDF.load(content, build_scene_graph=False, load_meshes=False).robot
    names = [link.name for link in robot.links]
    order = _checked_tree(path, names, [(joint.name, joint.parent, joint.child) for joint in robot.joints])
    poses, joints = {name: np.eye(4) for name in names}, list[_Joint]()
    for joint in (robot.joints[index] for index in order):
        frame = poses[joint.parent] @ _origin(joint)
        poses[joint.child] = frame
        limits = (None, None) if joint.limit is None else (joint.limit.lower or 0.0, joint.limit.upper or 0.0)
        mimic = None if joint.mimic is None else (joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        ends = joint.type, joint.parent, joint.child
        joints.append(_Joint(joint.name, *ends, frame, np.asarray(joint.axis, dtype=np.float64), limits, mimic))
    seen = any(link.visuals for link in robot.links)
    shapes = dict[str, list[_Shape]]()
    for link in robot.links:
        shapes[link.name] = []
        for element in link.visuals if seen else link.collisions:
            place, what = poses[link.name] @ _origin(element), element.geometry
            if what.mesh is not None:
                scale = 1.0 if what.mesh.scale is None else what.mesh.scale
                file = _mesh_file(path, link.name, what.mesh.filename)
                shapes[link.name].append(_Shape(place, None, file, np.broadcast_to(scale, 3).astype(np.float64)))
            else:
                (kind, solid), *_ = ((key, value) for key, value in vars(what).items() if value is not None)
                shapes[link.name].append(_solid(path, link.name, kind, place, vars(solid)))
    return _Tree(path, {name: shapes[name] for name in _from_base(names, joints)}, joints)


def _origin(element: Any) -> Matrix:
    return np.eye(4) if element.origin is None else np.asarray(element.origin)


def _from_base(names: Sequence[str], joints: Sequence[_Joint]) -> list[str]:
    """Links in the order in which the joints reach them."""
    children = [joint.child for joint in joints]
    return [*(name for name in names if name not in children), *children]


def _read_sdf(path: Path) -> _Tree:
    root = _parsed(path, "sdf", "SDF file")
    models = [*root.iterfind("model"), *root.iterfind("world/model")]
    if len(models) != 1:
        raise ValueError(f"{path} has {len(models)} models; it must have one, which is the object: leave out the others")
    (model,) = models
    if nested := [each.tag for each in model if each.tag in ("model", "include")]:
        raise ValueError(f"{path}: its model has a <{nested[0]}>, which is not known: write its links in its place")
    with readable(path, "SDF file"):
        links = {link.attrib["name"]: link for link in model.iterfind("link")}
        children = {joint.attrib["name"]: joint.findtext("child", "").strip() for joint in model.iterfind("joint")}
    poses, pending = dict[str, Matrix](), set[str]()

    def pose(element: Any, base: str) -> Matrix:
        """Pose of an element of ``base`` in the model; "" is the model itself."""
        if (seen := element.find("pose")) is not None:
            base = seen.get("relative_to", base).replace("__model__", "")
        numbers = [0.0] * 6 if seen is None else _numbers(path, "a <pose>", seen.text, 6)
        degrees = seen is not None and seen.get("degrees") == "true"
        return link_pose(base) @ rigid(Rotation.from_euler("xyz", numbers[3:], degrees).as_matrix(), numbers[:3])

    def link_pose(name: str) -> Matrix:
        if name == "":
            return np.eye(4)
        if name not in links or (name in pending and name not in poses):
            raise ValueError(
                f"{path}: a <pose> is relative to {name!r}; it must be another link of the model: write it relative to one"
            )
        if name not in poses:
            pending.add(name)
            poses[name] = pose(links[name], "")
        return poses[name]

    joints = list[_Joint]()
    for element in model.iterfind("joint"):
        name, child, parent = element.get("name"), children[element.get("name")], element.findtext("parent", "").strip()
        if parent == "world":  # the camera may see it from anywhere
            continue
        frame, axis = pose(element, child), element.find("axis")
        direction, limits, mimic = np.zeros(3), (None, None), None
        if axis is not None:
            xyz = axis.find("xyz")
            direction = np.array(_numbers(path, f"the axis of joint {name!r}", None if xyz is None else xyz.text, 3))
            base = "" if xyz is None else xyz.get("expressed_in", "")
            if axis.findtext("use_parent_model_frame", "").strip() in ("1", "true") or base == "__model__":
                direction = frame[:3, :3].T @ direction
            elif base:
                direction = frame[:3, :3].T @ link_pose(base)[:3, :3] @ direction
            limits = tuple(  # type: ignore[assignment]
                None if text is None else _numbers(path, f"a limit of joint {name!r}", text, 1)[0]
                for text in (axis.findtext("limit/lower"), axis.findtext("limit/upper"))
            )
            if (follow := axis.find("mimic")) is not None:
                factor, offset, start = (
                    _numbers(path, f"the <mimic> of joint {name!r}", follow.findtext(key, default), 1)[0]
                    for key, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
                )
                mimic = (follow.get("joint", ""), factor, offset - factor * start)
        joints.append(_Joint(name, element.get("type", ""), parent, child, frame, direction, limits, mimic))
    order = _checked_tree(path, list(links), [(joint.name, joint.parent, joint.child) for joint in joints])
    joints = [joints[index] for index in order]
    kind = "visual" if any(link.find("visual") is not None for link in links.values()) else "collision"
    shapes = dict[str, list[_Shape]]()
    for name in _from_base(list(links), joints):
        shapes[name] = []
        for element in links[name].iterfind(kind):
            geometry = element.find("geometry")
            if geometry is None or len(geometry) == 0:
                raise ValueError(f"{path}: a <{kind}> of link {name!r} has no <geometry>: add it, or leave it out")
            place, what = pose(element, name), geometry[0]
            if what.tag == "mesh":
                scale = np.array(_numbers(path, f"the scale of a mesh of {name!r}", what.findtext("scale", "1 1 1"), 3))
                shapes[name].append(_Shape(place, None, _mesh_file(path, name, what.findtext("uri", "")), scale))
            else:
                sizes = {each.tag: np.array(_numbers(path, f"a <{each.tag}>", each.text, None)) for each in what}
                shapes[name].append(_solid(path, name, what.tag, place, sizes))
    return _Tree(path, shapes, joints)


def _numbers(path: Path, what: str, text: str | None, count: int | None) -> list[float]:
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if not numbers or count not in (None, len(numbers)):
        raise ValueError(f"{path}: {what} is {str(text)[:60]!r}; it must be {count or 'some'} numbers: correct it")
    return numbers


def _solid(path: Path, link: str, kind: str, place: Matrix, sizes: Mapping[str, Any]) -> _Shape:
    """Box, cylinder, capsule or sphere by its sizes, which are lengths above 0."""
    needed = {"box": ("size",), **dict.fromkeys(("cylinder", "capsule"), ("radius", "length")), "sphere": ("radius",)}
    if kind not in needed:
        raise ValueError(f"{path}: link {link!r} has a <{kind}>; it must be one of {listed(needed)}, or a mesh: make one")
    values = [np.ravel(sizes.get(key, np.nan)) for key in needed[kind]]
    if [len(value) for value in values] != ([3] if kind == "box" else [1] * len(values)) or not all(
        (value > 0).all() for value in values
    ):
        raise ValueError(f"{path}: a {kind} of link {link!r} needs the {listed(needed[kind])}, above 0: correct it")
    if kind == "box":
        return _Shape(place, trimesh.creation.box(values[0]))
    if kind == "sphere":
        return _Shape(place, trimesh.creation.icosphere(3, float(values[0][0])))
    radius, length = (float(value[0]) for value in values)
    if kind == "cylinder":
        return _Shape(place, trimesh.creation.cylinder(radius, length))
    solid = trimesh.creation.capsule(length, radius)
    return _Shape(place, solid.apply_translation(-solid.bounds.mean(axis=0)))  # releases differ in where it begins


def _mesh_file(path: Path, link: str, name: str | None) -> Path:
    """File of a mesh that a link names: relative to the robot's file, or in a package in the folders above it."""
    scheme, _, rest = (name or "").strip().rpartition("://")
    folder = path.resolve().parent
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        tries = [
            base / part
            for base in (folder, *folder.parents)
            for part in (rest, *([inside] if base.name == package or (base / "package.xml").is_file() else []))
        ]
        if file := next((file for file in tries if file.is_file()), None):
            return file
        raise FileNotFoundError(
            f"{path}: link {link!r} names the mesh {name!r}, and no folder above the file holds {rest!r}: put the "
            "package there, or write paths relative to the file"
        )
    if scheme not in ("", "file") or not rest:
        raise ValueError(f"{path}: link {link!r} names the mesh {name!r}; it must be a path or package://...: correct it")
    if not (file := folder / rest).is_file():
        raise FileNotFoundError(
            f"{path}: link {link!r} names the mesh {name!r}, and {file} does not exist: copy it there, or correct the path"
        )
    return file


# --- the robot of links and joints ------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def _assembled(known: _Known) -> Robot:
    tree = known.tree
    limits, notes = _limits(tree), list[str]()
    carriers: dict[str, tuple[str, ...]] = {name: () for name in tree.shapes}
    for joint in tree.joints:  # from the base on
        carriers[joint.child] = carriers[joint.parent] + ((joint.name,) if joint.name in limits else ())
    names = dict[tuple[str, ...], str]()
    shapes = dict[str, list[tuple[np.ndarray, np.ndarray]]]()
    for link, each in tree.shapes.items():
        for shape in each:
            name = names.setdefault(carriers[link], link)
            shapes.setdefault(name, []).extend(shape.pieces())
    if not shapes:
        raise ValueError(f"{tree.path} has no link with a shape, of which a camera could see something: add meshes")
    for name, pieces in shapes.items():
        if not all((np.abs(vertices) <= LARGEST).all() for vertices, _ in pieces):
            raise ValueError(f"{tree.path}: a pose or size of link {name!r} is NaN, infinite or too large: correct it")
    segments = list[Segment]()
    for name, pieces in shapes.items():
        color = PALETTE[len(segments) % len(PALETTE)]
        segments.append(
            Segment(name, color, *united([Segment(str(k), color, *piece) for k, piece in enumerate(pieces)]))
        )
    joints = list[RobotJoint]()
    for joint in reversed(tree.joints):
        moved = tuple(name for chain, name in names.items() if joint.name in chain)
        if joint.name in limits and not 0 < len(moved) < len(names):
            what = "nothing that has a shape" if not moved else "the whole object, as its pose does"
            notes.append(f"joint {joint.name!r} is left out, for it moves {what}")
        elif joint.name in limits:
            frame, axis = joint.T_robot_joint, joint.axis / np.linalg.norm(joint.axis)
            leader, least, most = limits[joint.name]
            parts = MOVING[joint.kind], frame[:3, 3], frame[:3, :3] @ axis, (least, most), moved, leader
            joints.append(RobotJoint(joint.name, *parts))
    return Robot(SegmentedMesh(tuple(segments)), _with_leaders(joints), tuple(notes))


def _with_leaders(joints: Sequence[RobotJoint]) -> tuple[RobotJoint, ...]:
    """Joints, of which those whose leader was left out have a value of their own."""
    names = {joint.name for joint in joints}
    alone = {
        joint.name: RobotJoint(
            joint.name, joint.turns, joint.pivot, joint.axis, (min(joint.limits), max(joint.limits)), joint.moved
        )
        for joint in joints
        if joint.follows and joint.follows not in names
    }
    return tuple(alone.get(joint.name, joint) for joint in joints)


def _limits(tree: _Tree) -> dict[str, tuple[str, float, float]]:
    """Of each joint that moves: the joint that it follows or "", and its range, as ``RobotJoint`` has them."""
    by_name, ranges = {joint.name: joint for joint in tree.joints}, dict[str, tuple[str, float, float]]()
    for joint in tree.joints:
        if joint.kind not in KINDS:
            raise ValueError(
                f"{tree.path}: joint {joint.name!r} is of the kind {joint.kind!r}; it must be {', '.join(KINDS)}: make "
                "it fixed, or two joints with a link between them"
            )
        if joint.kind == "fixed":
            continue
        if not (np.isfinite(joint.axis).all() and np.linalg.norm(joint.axis) > 0):
            raise ValueError(f"{tree.path}: the axis of joint {joint.name!r} must be a direction: correct it")
        factor, offset, leader, passed = 1.0, 0.0, joint, list[str]()
        while leader.mimic is not None:
            name, multiplier, shift = leader.mimic
            if name not in by_name or by_name[name].kind == "fixed" or name in (joint.name, *passed) or not multiplier:
                raise ValueError(
                    f"{tree.path}: joint {joint.name!r} mimics {name!r} by the multiplier {multiplier:g}; it must be "
                    "another joint that moves, by other than 0: correct it"
                )
            passed.append(name)
            factor, offset, leader = factor * multiplier, offset + factor * shift, by_name[name]
        least, most = _range(tree.path, leader)
        if most > least:  # else it is as fixed
            follows = "" if leader is joint else leader.name
            ranges[joint.name] = follows, factor * least + offset, factor * most + offset
    return ranges


def _range(path: Path, joint: _Joint) -> tuple[float, float]:
    """Least and greatest value of a joint that follows none."""
    if joint.kind == "continuous":
        return FULL_TURN
    least, most = ((sign * np.inf) if limit is None else limit for sign, limit in zip((-1, 1), joint.limits, strict=True))
    if least > most or np.isnan(least + most) or (joint.kind == "prismatic" and not most - least < LARGEST):
        raise ValueError(
            f"{path}: joint {joint.name!r} has the limits {least:g} and {most:g}; it must have two, the lower first: "
            "correct its <limit>"
        )
    return FULL_TURN if joint.kind == "revolute" and most - least > FULL_TURN[1] - FULL_TURN[0] else (least, most)
