"""Robots of URDF, SDF and MJCF files: links as segments where all joints are zero, and the joints that move them.

file -yourdfpy, _read_sdf, _read_mjcf-> yourdfpy's Robot (links, joints) -_assembled-> Robot (segments, joints)

Lengths are metres and angles radians, as all three formats have them; positions are in the frame of the base.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from math import inf, nan, pi
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
import trimesh
from numpy import ndarray
from numpy.linalg import norm
from scipy.spatial.transform import Rotation

from mereo.geometry.conventions import LARGEST, Names, Range, Texts
from mereo.geometry.mesh import PALETTE, AnyMesh, Segment, SegmentedMesh, palette_color
from mereo.geometry.mesh_check import united
from mereo.geometry.transforms import NamedPoses, Transform, Vector, inverse_rigid, rigid, transform_points
from mereo.io.config import RobotMeshes
from mereo.io.errors import AnyPath, readable
from mereo.io.extras import library
from mereo.io.mesh_formats import read_object_mesh

ROBOT_SUFFIXES = (".urdf", ".sdf", ".xml", ".xacro")
"""Suffixes of files of robots, whose links are meshes; of macro files it is said what to do."""

HEAD_BYTES = 4096
"""Bytes at the beginning of an XML file, comments before its first element included, that say whether it is MJCF."""

KINDS = ("revolute", "continuous", "prismatic", "fixed")
"""Kinds of joints that are known."""


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
    limits: Range
    moved: Names
    follows: str


@dataclass(frozen=True, eq=False)
class Robot:
    """Robot of a file.

    Attributes:
        mesh: a segment for each link that moves, with all links fixed to it, called after the first of them that has a
            shape; where all joints are zero.
        link_frames: pose in the base of the link that a segment is called after, there too.
        joints: those that move some of the segments against others, the tip of each chain first.
        notes: sentences about joints that are left out, and about links without shapes of the kind that is taken.
    """

    mesh: SegmentedMesh
    link_frames: NamedPoses
    joints: tuple[RobotJoint, ...]
    notes: Names


def is_robot(path: Path) -> bool:
    """Whether a path names a URDF, SDF or MJCF file; other XML files are none."""
    if path.suffix.lower() != ".xml":
        return path.suffix.lower() in ROBOT_SUFFIXES
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<mujoco" in file.read(HEAD_BYTES)


def read_object_file(path: Path, robot_meshes: RobotMeshes = "visual") -> SegmentedMesh:
    """Segments of an object's file: the links of a robot where all joints are zero, else as ``read_object_mesh``.

    Raises as ``read_robot`` and ``read_segmented_mesh`` do, and ``ValueError`` for collision meshes of another file.
    """
    if path.suffix.lower() in ROBOT_SUFFIXES:
        return read_robot(path, robot_meshes).mesh
    if robot_meshes != "visual":
        raise ValueError(f"--robot-meshes is {robot_meshes}, but {path} is no robot's file: leave it out")
    return read_object_mesh(path)


def read_robot(path: AnyPath, robot_meshes: RobotMeshes = "visual") -> Robot:
    """Read a robot from a URDF, SDF or MJCF file, with the meshes that it names.

    Shapes are those of the visual or of the collision elements, and of links that have none of these, the others.
    ``package://NAME/...`` and ``model://NAME/...`` are looked for in the folders above the file.

    Raises ``FileNotFoundError`` for a missing file or mesh; ``ValueError`` for a damaged file, a joint that is neither
    revolute, continuous, prismatic nor fixed, links that form no tree, and a robot without shapes; ``ImportError``
    without the extra `robot`, and of an MJCF file without `simulation`.
    """
    path = Path(path)
    kind = "MJCF" if path.suffix.lower() == ".xml" else path.suffix[1:].upper()
    yourdfpy, etree = library("yourdfpy", "robot", path), library("lxml.etree", "robot", path)
    with readable(path, f"robot in {kind}"):
        parser = etree.XMLParser(resolve_entities=False, remove_comments=True, remove_pis=True)
        root = etree.parse(BytesIO(path.read_bytes()), parser).getroot()
        if any("xacro" in element.tag for element in root.iter(etree.Element)):
            raise ValueError("it is a macro file: expand it by `xacro FILE > robot.urdf`, and name that")
        if kind == "MJCF":
            return _assembled(_read_mjcf(path, yourdfpy, library("mujoco", "simulation", path), robot_meshes))
        if kind == "URDF":
            described = _read_urdf(yourdfpy, root, etree.tostring(root, encoding="utf-8"))
            link_frames = NamedPoses()
        else:
            described, link_frames = _read_sdf(yourdfpy, root)
        for link in described.links if robot_meshes == "collision" else ():
            link.visuals, link.collisions = link.collisions, link.visuals
        for joint in described.joints:
            joint.axis = np.reshape(joint.axis, 3)
        every = [(link.name, each) for link in described.links for each in (link.visuals or link.collisions)]
        solids = [_solid(each.geometry) for _, each in every]
    shapes = list[_Shape]()
    states = [(str(path), path.stat())]
    for (link, each), solid in zip(every, solids, strict=True):
        if solid is None:
            mesh = each.geometry.mesh
            file = _mesh_file(path, link, mesh.filename or "")
            states.append((str(file), file.stat()))
            shapes.append(_Shape(link, _origin(each), file, mesh.scale))
        else:
            shapes.append(_Shape(link, _origin(each), solid))
    known = tuple((name, state.st_ino, state.st_size, state.st_mtime_ns) for name, state in states)
    return _assembled(_Described(path, described, link_frames, shapes, known, robot_meshes))


def _solid(geometry: Any) -> trimesh.Trimesh | None:
    """Solid of a box, cylinder or sphere, or that it is; None of a mesh, whose scale gets three numbers."""
    if isinstance(geometry, trimesh.Trimesh):
        return geometry
    if geometry.mesh is not None:
        geometry.mesh.scale = np.ones(3) * (1.0 if geometry.mesh.scale is None else geometry.mesh.scale)
        return None
    if geometry.box is not None:
        return trimesh.creation.box(geometry.box.size)
    if geometry.cylinder is not None:
        return trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length)
    return trimesh.creation.icosphere(3, geometry.sphere.radius)


def _read_urdf(yourdfpy: Any, root: Any, content: bytes) -> Any:
    for joint in root.iterfind("joint"):  # which the library takes for granted
        if joint.find("parent") is None or joint.find("child") is None:
            raise ValueError(f"its joint {joint.get('name')!r} has no <parent> or no <child>")
    for shape in root.iterfind("link/*"):
        if shape.tag in ("visual", "collision") and shape.find("geometry/*") is None:
            raise ValueError(f"a <{shape.tag}> of its link {shape.getparent().get('name')!r} has no geometry")
    return yourdfpy.URDF.load(BytesIO(content), build_scene_graph=False, load_meshes=False).robot


def _read_sdf(yourdfpy: Any, root: Any) -> tuple[Any, NamedPoses]:
    """Robot of an SDF file's only model, as yourdfpy would have it from a URDF file: links in the frames of joints.

    With it come the poses of the links' own frames in those.
    """
    models = [*root.iterfind("model"), *root.iterfind("world/model")]
    if len(models) != 1 or models[0].find("include") is not None or models[0].find("model") is not None:
        raise ValueError(f"it has {len(models)} models; it must have one, without others in it")
    (model,) = models
    elements = {each.get("name"): each for kind in ("frame", "joint", "link") for each in model.iterfind(kind)}
    names = {"link": "", "joint": "child", "frame": "attached_to"}
    poses = {"": np.eye(4), "__model__": np.eye(4)}
    pending = set[str]()

    def pose_of(name: str) -> Transform:
        """Pose of a link, joint or frame in the model."""
        if name not in poses:
            if name in pending or name not in elements:
                raise ValueError(f"a pose is relative to {name!r}, which is no other link, joint or frame")
            pending.add(name)
            element = elements[name]
            base = names[element.tag]
            poses[name] = pose(element, (element.findtext(base) or element.get(base, "")) if base else "")
        return poses[name]

    def pose(element: Any, base: str) -> Transform:
        place = element.find("pose")
        if place is None:
            return pose_of(base.strip())
        x, y, z, *angles = _numbers((place.text or "").strip() or "0 0 0 0 0 0", 6)
        turn = Rotation.from_euler("xyz", angles, degrees=place.get("degrees") == "true").as_matrix()
        return pose_of(place.get("relative_to", base.strip())) @ rigid(turn, np.array([x, y, z]))

    joints = list[Any]()
    frames = {link.get("name"): pose_of(link.get("name")) for link in model.iterfind("link")}
    for element in model.iterfind("joint"):
        name, parent, child = element.get("name"), *(element.findtext(key, "").strip() for key in ("parent", "child"))
        if parent != "world":  # the camera may see it from anywhere
            frames[child] = pose_of(name)
            joint = yourdfpy.Joint(name, element.get("type"), parent, child, axis=np.zeros(3))
            joints.append(_with_axis(yourdfpy, joint, element.find("axis"), pose_of))
    for joint in joints:
        joint.origin = inverse_rigid(frames.get(joint.parent, np.eye(4))) @ frames[joint.child]
    links = list[Any]()
    for element in model.iterfind("link"):
        link = yourdfpy.Link(element.get("name"))
        for kind, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for each in element.iterfind(kind):
                place = inverse_rigid(frames[link.name]) @ pose(each, link.name)
                shapes.append(yourdfpy.Visual(None, place, _geometry(yourdfpy, each)))
        links.append(link)
    link_frames = {name: inverse_rigid(frame) @ pose_of(name) for name, frame in frames.items()}
    return yourdfpy.Robot(model.get("name"), links, joints), link_frames


def _with_axis(yourdfpy: Any, joint: Any, axis: Any, pose_of: Any) -> Any:
    """Joint of an SDF file with its axis, limits and leader."""
    if axis is None:
        return joint
    base = axis.find("xyz").get("expressed_in") or joint.name
    if axis.findtext("use_parent_model_frame", "").strip() in ("1", "true"):
        base = "__model__"
    turn = pose_of(joint.name)[:3, :3].T @ pose_of(base)[:3, :3]
    joint.axis = turn @ _numbers(axis.findtext("xyz"), 3)
    lower, upper = _number(axis, "limit/lower", "-inf"), _number(axis, "limit/upper", "inf")
    joint.limit = yourdfpy.Limit(lower=lower, upper=upper)
    if (leader := axis.find("mimic")) is not None:
        factor, start = _number(leader, "multiplier", "1"), _number(leader, "reference", "0")
        offset = _number(leader, "offset", "0") - factor * start
        joint.mimic = yourdfpy.Mimic(leader.get("joint"), factor, offset)
    return joint


def _number(element: Any, key: str, default: str) -> float:
    """Number of an element within another one, ``default`` where there is none."""
    return _numbers(element.findtext(key) or default, 1)[0]


def _geometry(yourdfpy: Any, element: Any) -> Any:
    """Shape of a visual or collision element of an SDF file: a solid, or yourdfpy's of one that names a mesh."""
    shape = element.find("geometry/*")
    if shape is None:
        raise ValueError(f"its <{element.tag}> {element.get('name')!r} has no geometry")
    if shape.tag == "mesh":
        scale = np.array(_numbers(shape.findtext("scale", "1 1 1"), 3))
        return yourdfpy.Geometry(mesh=yourdfpy.Mesh(shape.findtext("uri", "").strip(), scale))
    if shape.tag == "box":
        return trimesh.creation.box(_numbers(shape.findtext("size"), 3))
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(3, _number(shape, "radius", ""))
    if shape.tag in ("cylinder", "capsule"):
        radius, length = (_number(shape, key, "") for key in ("radius", "length"))
        return trimesh.creation.cylinder(radius, length) if shape.tag == "cylinder" else _capsule(radius, length)
    raise ValueError(f"its <{element.tag}> {element.get('name')!r} is a {shape.tag}, which is not known")


# --- MJCF, which its own library reads and compiles -------------------------------------------------------------------


def _read_mjcf(path: Path, yourdfpy: Any, mujoco: Any, robot_meshes: RobotMeshes) -> "_Described":
    """Robot of an MJCF file: each body is a link, each of its joints carries a frame of its own.

    All frames have the axes of the world where all joints are zero. What is fixed in the world is no part of it; its
    only body there may be free, as the camera may see it from anywhere.
    """
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    data.qpos[model.jnt_qposadr[np.isin(model.jnt_type, list(kinds))]] = 0.0
    mujoco.mj_kinematics(model, data)
    names = [model.body(number).name or f"body {number}" for number in range(model.nbody)]
    links = {name: yourdfpy.Link(name) for name in names}
    joints = list[Any]()
    place = {names[0]: np.zeros(3)}
    is_alone = int((model.body_parentid[1:] == 0).sum()) == 1
    for body in range(1, model.nbody):
        carrier = names[model.body_parentid[body]]
        chain = list[Any]()
        for number in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            joint = model.joint(number)
            name = joint.name or f"joint {number}"
            kind = kinds.get(int(model.jnt_type[number]))
            if kind is not None:
                lower, upper = joint.range if model.jnt_limited[number] else (-inf, inf)
                limit = yourdfpy.Limit(lower=float(lower), upper=float(upper))
                mimic = _mjcf_mimic(model, mujoco, yourdfpy, number)
                each = yourdfpy.Joint(name, kind, axis=data.xaxis[number].copy(), limit=limit, mimic=mimic)
                chain.append((each, data.xanchor[number].copy()))
            elif int(model.jnt_type[number]) == int(mujoco.mjtJoint.mjJNT_BALL) or body != 1 or not is_alone:
                raise ValueError(f"its joint {name!r} turns or moves freely, which no joint with one value does")
        chain = chain or [
            (yourdfpy.Joint(f"fixed {names[body]}", "fixed", axis=np.array([1.0, 0, 0])), data.xpos[body].copy())
        ]
        for index, (joint, at) in enumerate(chain):
            frame = names[body] if index == len(chain) - 1 else f"{names[body]} {index}"
            links.setdefault(frame, yourdfpy.Link(frame))
            joint.parent, joint.child, joint.origin = carrier, frame, rigid(np.eye(3), at - place[carrier])
            place[frame], carrier = at, frame
            joints.append(joint)
    shapes = list[_Shape]()
    link_frames = NamedPoses()
    for body in range(1, model.nbody):
        at = data.xpos[body] - place[names[body]]
        link_frames[names[body]] = rigid(data.xmat[body].reshape(3, 3), at)
        geoms = np.arange(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        collides = (model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)
        is_taken = collides == (robot_meshes == "collision")
        for geom in geoms[is_taken] if is_taken.any() else geoms:
            T = rigid(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom] - place[names[body]])
            shapes += [_Shape(names[body], T, solid) for solid in _mjcf_solids(model, mujoco, int(geom))]
    compiled = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    robot = yourdfpy.Robot(path.stem, list(links.values()), joints)
    states = ((str(path), crc32(compiled.tobytes()), len(compiled), 0),)
    return _Described(path, robot, link_frames, shapes, states, robot_meshes)


def _mjcf_mimic(model: Any, mujoco: Any, yourdfpy: Any, number: int) -> Any:
    """Joint that another one follows, by which factor and offset; None where no linear constraint says so."""
    for row in np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)):
        first, second, (offset, factor, *curved) = model.eq_obj1id[row], model.eq_obj2id[row], model.eq_data[row, :5]
        if first == number and second >= 0 and not any(curved):
            zero, leader_zero = (model.qpos0[model.jnt_qposadr[each]] for each in (first, second))
            offset += zero - factor * leader_zero
            return yourdfpy.Mimic(model.joint(second).name or f"joint {second}", float(factor), float(offset))
    return None


def _mjcf_solids(model: Any, mujoco: Any, geom: int) -> Iterator[trimesh.Trimesh]:
    """Solids of a shape, as its library has compiled it; none of planes and height fields, which are no part of it."""
    kind, (x, y, z) = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
        yield trimesh.Trimesh(vertices, model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]], process=False)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        yield trimesh.creation.box(2 * np.array([x, y, z]))
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        yield trimesh.creation.cylinder(x, 2 * y)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        yield _capsule(x, 2 * y)
    elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(3)
        yield trimesh.Trimesh(ball.vertices * ([x, y, z] if y else x), ball.faces, process=False)


def _capsule(radius: float, length: float) -> trimesh.Trimesh:
    """Capsule, made with the radius 1: the library joins points that are nearer than 10 nm, as those of small ones."""
    return trimesh.creation.capsule(length / radius, 1.0).apply_scale(radius)


def _numbers(text: str | None, count: int) -> list[float]:
    numbers = [float(word) for word in (text or "").split()]
    if len(numbers) != count:
        raise ValueError(f"{text!r} is not {count} numbers")
    return numbers


def _mesh_file(path: Path, link: str, name: str) -> Path:
    """File of a mesh that a link names: relative to the robot's file, or in a package in the folders above it."""
    scheme, _, rest = name.rpartition("://")
    folder = path.resolve().parent
    tries = [path.resolve().parent / rest]
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        above = (folder, *folder.parents)
        tries = [base / rest for base in above]
        tries += [base / inside for base in above if base.name == package or (base / "package.xml").is_file()]
    for file in tries:
        if file.is_file():
            return file
    where = "no folder above the file has it" if len(tries) > 1 else f"{tries[0]} does not exist"
    raise FileNotFoundError(
        f"{path}: link {link!r} names the mesh {name!r}, and {where}: put it there, or correct the path"
    )


# --- the robot of links and joints ------------------------------------------------------------------------------------


class _Shape(NamedTuple):
    """Shape of a link: a solid, or a mesh's file with its scale."""

    link: str
    T_link_shape: Transform
    content: trimesh.Trimesh | Path
    scale: Vector | None = None

    def surfaces(self) -> Iterator[AnyMesh]:
        """Vertices and faces of its parts in its own frame."""
        if isinstance(self.content, Path):
            assert self.scale is not None
            for part in read_object_mesh(self.content).segments:
                # a mirrored surface faces inwards
                yield part.vertices * self.scale, part.faces[:, :: -1 if np.prod(self.scale) < 0 else 1]
        else:
            yield np.asarray(self.content.vertices), np.asarray(self.content.faces, np.int64)


@dataclass(frozen=True)
class _Described:
    """Content of a file: yourdfpy's robot and its shapes; equal where ``states`` of files and ``robot_meshes`` are.

    ``link_frames`` are those of the file, in the robot's, where they are not the same.
    """

    path: Path = field(compare=False)
    robot: Any = field(compare=False)
    link_frames: NamedPoses = field(compare=False)
    shapes: list[_Shape] = field(compare=False)
    states: tuple[tuple[str, int, int, int], ...]
    robot_meshes: RobotMeshes


@lru_cache(maxsize=16)
def _assembled(content: _Described) -> Robot:
    path = content.path
    joints = _from_base(content.path, content.robot)
    limits = _limits(path, joints)
    poses = {link.name: np.eye(4) for link in content.robot.links}
    carriers = dict.fromkeys(poses, ())
    for joint in joints:
        poses[joint.child] = poses[joint.parent] @ _origin(joint)
        carriers[joint.child] = carriers[joint.parent] + ((joint.name,) if joint.name in limits else ())
    names = dict[Names, str]()
    parts = dict[str, list[Segment]]()
    order = [*(link for link in poses if not carriers[link]), *(joint.child for joint in joints)]
    for shape in sorted(content.shapes, key=lambda shape: order.index(shape.link)):
        pieces = parts.setdefault(names.setdefault(carriers[shape.link], shape.link), [])
        for vertices, faces in shape.surfaces():
            vertices = transform_points(poses[shape.link] @ shape.T_link_shape, vertices)
            _check_numbers(path, shape.link, vertices)
            pieces.append(Segment(str(len(pieces)), PALETTE[0], vertices, faces))
    if not parts:
        raise ValueError(f"{path} has no link with a shape, of which a camera could see something: add meshes")
    colors = (palette_color(index) for index in range(len(parts)))
    segments = (Segment(name, color, *united(each)) for (name, each), color in zip(parts.items(), colors, strict=True))
    moved = {joint: tuple(name for chain, name in names.items() if joint in chain) for joint in limits}
    kept = {joint: each for joint, each in moved.items() if 0 < len(each) < len(names)}
    notes = [f"joint {name!r} is left out, for it moves no segment against others" for name in limits.keys() - kept]
    stood_in = [link for link in content.robot.links if link.collisions and not link.visuals]
    notes += [f"link {each.name!r} has no {content.robot_meshes} shape, so its others are taken" for each in stood_in]
    joined = []
    for joint in reversed(joints):
        if joint.name in kept:
            leader, *ends = limits[joint.name]
            ends = ends if leader in kept else sorted(ends)
            axis = poses[joint.child][:3, :3] @ (joint.axis / norm(joint.axis))
            place = joint.type != "prismatic", poses[joint.child][:3, 3], axis, (ends[0], ends[1])
            _check_numbers(path, joint.name, np.array([*poses[joint.child][:3, 3], *axis, *np.rad2deg(ends)]))
            joined.append(RobotJoint(joint.name, *place, kept[joint.name], leader if leader in kept else ""))
    frames = {name: poses[name] @ content.link_frames.get(name, np.eye(4)) for name in parts}
    return Robot(SegmentedMesh(tuple(segments)), frames, tuple(joined), tuple(sorted(notes)))


def _check_numbers(path: Path, name: str, values: ndarray) -> None:
    if not (np.abs(values) <= LARGEST).all():
        raise ValueError(
            f"{path}: a pose, size or limit of {name!r} is NaN, infinite or beyond {LARGEST:g}: correct it"
        )


def _origin(element: Any) -> Transform:
    return np.eye(4) if element.origin is None else np.asarray(element.origin)


def _from_base(path: Path, robot: Any) -> list[Any]:
    """Joints, each after those that carry it; raises ``ValueError`` where links and joints form no tree."""
    links = [link.name for link in robot.links]
    above = Texts()
    for joint in robot.joints:
        if joint.parent not in links or joint.child not in links:
            raise ValueError(f"{path}: joint {joint.name!r} names a link that is not in the file: correct it")
        if joint.child in above:
            raise ValueError(
                f"{path}: link {joint.child!r} is carried by the joints {above[joint.child]!r} and {joint.name!r}; a "
                "robot is a tree without loops: leave one of them out"
            )
        above[joint.child] = joint.name
    reached = {link for link in links if link not in above}
    joints = list[Any]()
    if len(reached) != 1 or len(set(links)) < len(links):
        raise ValueError(
            f"{path} has {len(reached)} links that no joint carries ({', '.join(sorted(reached))}); it must be one, "
            "the base, and each link has a name for itself: correct its joints"
        )
    while new := [joint for joint in robot.joints if joint.parent in reached and joint not in joints]:
        joints += new
        reached |= {joint.child for joint in new}
    if len(reached) < len(links):
        raise ValueError(f"{path}: joints of {min(set(links) - reached)!r} form a loop, and no tree: correct them")
    return joints


def _limits(path: Path, joints: Sequence[Any]) -> dict[str, tuple[str, float, float]]:
    """Of each joint that moves: the joint that it follows or "", and its range, as ``RobotJoint`` has them."""
    by_name = {joint.name: joint for joint in joints}
    ranges = dict[str, tuple[str, float, float]]()
    for joint in joints:
        if joint.type not in KINDS:
            raise ValueError(
                f"{path}: joint {joint.name!r} is of the kind {joint.type!r}; it must be {', '.join(KINDS)}: make it "
                "fixed, or several joints with links between them"
            )
        factor = 1.0
        offset = 0.0
        leader = joint
        passed = [joint.name]
        while leader.mimic is not None:
            name = leader.mimic.joint
            if name not in by_name or by_name[name].type == "fixed" or name in passed or leader.mimic.multiplier == 0:
                raise ValueError(
                    f"{path}: joint {joint.name!r} mimics {name!r}; it must be another one that moves it: correct it"
                )
            passed.append(name)
            factor, offset, leader = (
                factor * leader.mimic.multiplier,
                offset + factor * leader.mimic.offset,
                by_name[name],
            )
        least, most = _range(path, leader)
        if joint.type != "fixed" and most > least:
            if not 0 < norm(joint.axis) < LARGEST:
                raise ValueError(
                    f"{path}: joint {joint.name!r} has the axis {joint.axis}; it must be a direction: correct it"
                )
            ranges[joint.name] = "" if leader is joint else leader.name, factor * least + offset, factor * most + offset
    return ranges


def _range(path: Path, joint: Any) -> Range:
    """Least and greatest value of a joint that follows none: of one that turns, at most a turn."""
    limits = (None, None) if joint.limit is None else (joint.limit.lower, joint.limit.upper)
    least, most = (nan, nan) if limits == (None, None) else (limits[0] or 0.0, limits[1] or 0.0)
    if joint.type == "continuous" or (joint.type == "revolute" and most - least > 2 * pi):
        return -pi, pi
    if joint.type != "fixed" and not 0 <= most - least < LARGEST:
        raise ValueError(
            f"{path}: joint {joint.name!r} has the limits {least:g} and {most:g}; it must have two, the lower first: "
            "write them as <limit>"
        )
    return least, most
