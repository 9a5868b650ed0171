"""First draft of a scene file, for an object of which only the meshes are known: ``mereo scene new``.

The object is taken for rubber that deforms about as much as those of the built-in scenes. A lattice alone is too stiff
for that: the bound that keeps space from folding over limits it. So the object bends along its longest side, and two
lattices of cubes follow, one after the other, all scaled until the surface moves by ``MOTION``.
"""

import os
import re
import shlex
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from textwrap import indent
from typing import Any, NamedTuple

import numpy as np
import trimesh
import yaml
from numpy.linalg import norm, svd
from scipy.spatial import ConvexHull, QhullError

from mereo.deformation.maps import moved_by, unit
from mereo.deformation.samplers import RandomMotion, distance_from_line
from mereo.geometry.brief import counted, listed
from mereo.geometry.conventions import UNITS_M, Facts, Names, Range, Texts, Way
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh, palette_color, surface_points
from mereo.geometry.mesh_check import examine, likely_unit, overlaps
from mereo.geometry.transforms import (
    Corners,
    Indices,
    Normalizer,
    Points,
    Vector,
    fit_rigid,
    inverse_rigid,
    longest_side,
    transform_points,
)
from mereo.io.atomic_files import JsonObject, check_file_place, write_file
from mereo.io.config import MeshesConfig, RobotMeshes
from mereo.io.robots import ROBOT_SUFFIXES, RobotJoint, is_robot, read_object_file, read_robot
from mereo.io.volume_files import (
    LabelVolume,
    LabelWarning,
    ThinSegmentError,
    is_volume,
    read_label_volume,
    segment_surfaces,
)
from mereo.scenes.files.deformation_blocks import (
    SOFT,
    STIFF,
    BendBlock,
    DeformationBlock,
    ElasticBlock,
    JointBlock,
    LatticeBlock,
    Target,
)
from mereo.scenes.files.joints import SLIDES_ALONG, TURNS_ON, Joint, proposed_joints
from mereo.scenes.scene import SCENES, Draw, Workspace
from mereo.scenes.seeds import example_rng

# --- how far states move ----------------------------------------------------------------------------------------------

STATES, POINTS = 24, 800
"""Random states in which motion is measured, and places of the surface at which it is."""


class Motion(NamedTuple):
    """Root mean square and largest motion of the surface in a typical (median) state, in the object's longest sides."""

    mean: float
    largest: float


def measure_motion(rest: SegmentedMesh, draw: Draw) -> Motion:
    """Motion of an object in random states, which are the same in every call, beyond turns and shifts of the whole."""
    points, owner = material_points(rest, POINTS)
    states = [moved_by(points, owner, draw(example_rng(0, index))) for index in range(STATES)]
    ways = [moved - transform_points(fit_rigid(points, moved), points) for moved in states]
    shares = norm(ways, axis=2) / longest_side(rest.bounds)
    return Motion(float(np.median(np.sqrt(np.mean(shares**2, axis=1)))), float(np.median(shares.max(axis=1))))


def material_points(mesh: SegmentedMesh, count: int) -> tuple[Points, Indices]:
    """Points evenly spread over the surface of all segments, and the index of the segment of each."""
    vertices, faces, owner = mesh.merged()
    points, face = surface_points(vertices, faces, count)
    return points, owner[face]


# --- defaults ---------------------------------------------------------------------------------------------------------

MOTION = 0.05
"""Motion of the surface in a typical state, in longest sides: that of the bunny and of the liver."""

LATTICES, MOST_STRENGTH, MOST_BEND_DEG = 2, 0.9, 120.0

BEND_SHARE = 0.8
"""Largest bend, as a share of that at which space folds over; ``samplers.FOLD_SHARE`` is the bound."""

UNPLACED = Normalizer(np.zeros(3), 1.0)

Blocks = tuple[ElasticBlock | BendBlock | LatticeBlock, ...]


def default_deformations(mesh: SegmentedMesh, motion: float = SOFT) -> Blocks:
    """States of an elastic solid; of segments that do not touch, those of a box of rubber around them.

    ``mesh`` is in the file's frame and unit, ``motion`` as ``ElasticBlock.motion``.
    """
    elastic = ElasticBlock(type="elastic", motion=motion)
    try:
        pieces = elastic.lattice(mesh).pieces
    except ValueError:  # it has no inside
        pieces = 0
    return (elastic,) if pieces == 1 else rubber(mesh)


def rubber(mesh: SegmentedMesh) -> Blocks:
    """Deformations under which the surface moves by about ``MOTION``, or by as much as does not fold space over."""
    strength = 1.0
    for _ in range(4):  # motion is nearly proportional to the strength
        blocks = _blocks(mesh, strength)
        moved = measure_motion(mesh, random_motion(mesh, blocks, UNPLACED)).mean
        if abs(moved / MOTION - 1) < 0.02 or (moved < MOTION and strength == 1.0):
            break
        strength = min(strength * MOTION / moved, 1.0)
    return _blocks(mesh, strength)


def _blocks(mesh: SegmentedMesh, strength: float) -> Blocks:
    """A bend along the longest side and ``LATTICES`` lattices, numbers rounded as they are written."""
    origin, longest, length = _longest_side(mesh)
    axis = np.eye(3)[longest]
    radius = distance_from_line(mesh.merged()[0], origin, axis)
    most = min(BEND_SHARE * np.rad2deg(length / radius), MOST_BEND_DEG)
    (x, y, z), (u, v, w) = (rounded(value) for value in origin), axis.tolist()
    angle = float(np.floor(most * strength))
    size = rounded(length)
    share = rounded(MOST_STRENGTH * strength, 2)
    bend = BendBlock(type="bend", origin=(x, y, z), axis=(u, v, w), length=size, angle=(-angle, angle))
    return (bend, *(LATTICES * [LatticeBlock(type="lattice", spacing=rounded(length / 2), strength=share)]))


def _longest_side(mesh: SegmentedMesh) -> tuple[Vector, int, float]:
    """Middle of the box's face at which its longest side begins, number of the axis along it, and its length."""
    low, high = mesh.bounds
    longest = int((high - low).argmax())
    start = (low + high) / 2
    start[longest] = low[longest]
    return start, longest, float((high - low)[longest])


def rounded(value: float, digits: int = 4) -> float:
    """Value with so many digits that count."""
    return float(f"{value:.{digits}g}")


def random_motion(mesh: SegmentedMesh, blocks: tuple[DeformationBlock, ...], placement: Normalizer) -> RandomMotion:
    """Maps that blocks draw for all segments of a mesh, which is placed already."""
    everything = tuple(range(len(mesh.segments)))
    target = Target(mesh, mesh.bounds, placement)
    return RandomMotion(mesh, tuple((block.sampler(target), everything) for block in blocks))


# --- the side on which it stands --------------------------------------------------------------------------------------

THICKNESS_SHARE = 0.08
"""Depth of what counts as the plane of a base, in ratios of the hull's volume to its area (a ball's radius is three):
scans of flat faces are bumpy."""

SAME_NORMAL, MOST_FACETS = 0.98, 200
"""Least cosine of a face's normal with that of the base; faces of the hull, the largest first, that are tried."""

LEAST_BASE, LEAST_COVER = 0.08, 0.25
"""Share of the hull's area within the outline of a base, and of that outline that is surface of the object: three
places of a rounded body are no base."""

LEAST_TILT = float(np.tan(radians(15.0)))
"""Slope on which the object still stands."""


@dataclass(frozen=True, eq=False)
class FlatBase:
    """Flat face on which an object stands stably.

    Attributes:
        normal: outward unit vector, exactly along an axis where it is nearly.
        share: of the area of the object's convex hull that lies within the outline of the face, from 0 to 1.
    """

    normal: Vector
    share: float

    def describe(self, workspace: Workspace) -> str:
        """One sentence: where it is, and what a camera in a workspace sees of it."""
        normal = " ".join(f"{value:.2g}" for value in self.normal + 0.0)
        text = f"it can stand on a flat base (normal {normal}, {self.share:.0%} of its hull)"
        axis = np.array(workspace.axis) / norm(workspace.axis)
        away = float(np.arccos(np.clip(axis @ self.normal, -1.0, 1.0)))
        if away - workspace.aperture_rad / 2 > np.pi / 2 - 0.01:
            return f"{text}, and the camera never looks from below"
        return (
            f"{text}: if it stays on a table, the camera never sees it from below; narrow it with "
            f"`camera: {{axis: {_numbers(-self.normal)}, aperture: 180}}`"
        )


def flat_base(mesh: SegmentedMesh, up: Sequence[float]) -> FlatBase | None:
    """Flat face on which an object can stand, the one opposite to ``up`` or else the largest; None where it has none.

    It is a part of the surface near a plane that supports the convex hull, large enough, and so wide that the centre of
    mass is above it also on a slope.
    """
    vertices, faces, _ = mesh.merged()
    solid = trimesh.Trimesh(vertices - vertices.mean(axis=0), faces, process=False)
    try:
        hull = solid.convex_hull
    except QhullError:  # it has no volume
        return None
    bases = list[FlatBase]()
    for normal in hull.face_normals[np.argsort(-hull.area_faces, kind="stable")[:MOST_FACETS]]:
        if not any(normal @ base.normal > SAME_NORMAL for base in bases):
            base = _base(solid, hull, normal)
            bases += [base] if base is not None else []
    lowest = [base for base in bases if base.normal @ np.array(up) < -SAME_NORMAL * norm(up)]
    return max(lowest or bases, key=lambda base: base.share, default=None)


def _base(solid: trimesh.Trimesh, hull: trimesh.Trimesh, normal: Vector) -> FlatBase | None:
    heights = solid.vertices @ normal
    top = heights.max() - THICKNESS_SHARE * hull.volume / hull.area
    crossed = solid.triangles_cross * np.sign(solid.triangles_cross @ normal)[:, None]
    areas = norm(crossed, axis=1)
    on = (heights[solid.faces].min(axis=1) > top) & (crossed @ normal > SAME_NORMAL * areas)
    if areas[on].sum() / 2 < LEAST_COVER * LEAST_BASE * hull.area:
        return None
    normal = unit(crossed[on].sum(axis=0))
    across = svd(normal[None])[2][1:]
    outline = ConvexHull(solid.vertices[np.unique(solid.faces[on])] @ across.T)
    center = (solid if solid.volume > 0.01 * hull.volume else hull).center_mass  # of open meshes it is nonsense
    inside = -float((outline.equations[:, :2] @ (across @ center) + outline.equations[:, 2]).max())
    share, cover = outline.volume / hull.area, areas[on].sum() / 2 / outline.volume
    height = float((solid.vertices @ normal).max() - center @ normal)
    if share < LEAST_BASE or cover < LEAST_COVER or inside < LEAST_TILT * height:
        return None
    nearest = np.round(normal)
    return FlatBase(nearest if np.abs(normal).max() > np.cos(radians(3.0)) else normal, float(share))


# --- the camera -------------------------------------------------------------------------------------------------------

NEAR = 100.0
FARTHER = 1.25
MOST_VIEW_RAD = radians(40.0)
"""Nearest distance of the camera in scene units, as in the paper, or as far as the object fills no wider view; and the
farthest in nearest ones. Twice, as in the paper, leaves a quarter of the picture's pixels."""

STATES_SEEN, VIEWS, MARGIN = 16, 64, 1.03
"""Random states in which an object is seen, and views of them; width of the picture, in widths of the widest view."""

FRAMED = 1000
"""Places of the surface that a view must show, and at most so many vertices of each segment."""


def _default_view(rest: SegmentedMesh, draw: Draw, workspace: Workspace) -> tuple[float, float, int]:
    """Nearest and farthest distance in scene units, and field of view in degrees, that random states fill uncut."""
    points, owner = material_points(rest, FRAMED)
    corners = [segment.vertices[:: 1 + len(segment.vertices) // FRAMED] for segment in rest.segments]
    owner = np.concatenate([owner, np.repeat(np.arange(len(corners)), [len(part) for part in corners])])
    points = np.concatenate([points, *corners])
    moved = [moved_by(points, owner, draw(example_rng(0, index))) for index in range(STATES_SEEN)]
    # the camera aims at the middle of their box
    states = [(places, (places.min(axis=0) + places.max(axis=0)) / 2) for places in moved]
    reach = max(float(norm(points - center, axis=1).max()) for points, center in states)
    near = max(NEAR, float(np.ceil(reach / np.sin(MOST_VIEW_RAD / 2))))
    widest = 0.0
    for index in range(VIEWS):
        points, center = states[index % STATES_SEEN]
        pose = workspace.sample(example_rng(1, index), center)
        pose[:3, 3] = center - near * pose[:3, 2]
        seen = transform_points(inverse_rigid(pose), points)
        widest = max(widest, float(np.abs(seen[:, :2] / seen[:, 2:]).max()))
    view = int(np.clip(np.ceil(np.rad2deg(2 * np.arctan(MARGIN * widest))), 5, 90))
    return near, float(np.ceil(FARTHER * near)), view


def placed(mesh: SegmentedMesh, size: float) -> Normalizer:
    """Map from the file's frame to the scene's: the joint box centred, its shortest side ``size`` long."""
    low, high = mesh.bounds
    shortest = float((high - low).min())
    if not shortest > 0:
        raise ValueError(f"the object's box has sides {(high - low).tolist()}; all must be above 0: check the meshes")
    return Normalizer((low + high) / 2, size / shortest)


# --- the file ---------------------------------------------------------------------------------------------------------

SIZE, LONGEST = 20.0, 80.0
"""Shortest side in scene units, as in the paper, unless the object is longer than ``LONGEST`` then."""

LABEL_CELLS = (64, 96, 128, 192)
"""Cells along the longest side of label volumes: the first number for which no segment is too thin."""


class _Source(NamedTuple):
    """Segments of files in their unit, the lines that name them, and the likely unit and upward axis, with reasons.

    ``assembly`` is whether the segments are parts, which may have joints, and not regions of one body; ``lost`` are
    sentences about segments that are left out, ``notes`` about what others lose; ``robot`` are a robot's joints.
    """

    block: str
    mesh: SegmentedMesh
    unit: str
    reason: str
    up: int
    up_reason: str
    assembly: bool = True
    lost: Names = ()
    notes: Names = ()
    robot: tuple[RobotJoint, ...] | None = None


def write_scene_file(
    files: Sequence[Path],
    output: Path | None = None,
    *,
    name: str | None = None,
    aperture: float = 360.0,
    report: Callable[[str], None] | None = None,
    **meshes: Any,
) -> Path:
    """Write a commented YAML file that names ``files`` relative to itself; returns its path.

    Args:
        files: one mesh for each segment, one file of named parts, a robot's file, one label volume, or one for each
            segment.
        output: by default ``NAME.yaml`` in the working directory, after the first file.
        name: of the scene; by default that of ``output``.
        aperture: of the cone about the side that is up from which the camera looks, above 0 to 360 degrees: all around.
        report: called with each sentence about what was found, once the file is written.
        meshes: what the files do not say, the fields of ``MeshesConfig``.

    Raises ``FileExistsError`` where ``output`` exists, ``ValueError`` and ``FileNotFoundError`` for unusable files, and
    where a segment has to be left out and nobody is there for the ``report``.
    """
    if not files:
        raise ValueError("no mesh is given; a scene needs at least one: name your files")
    name = identifier(name or (output or files[0]).name.split(".")[0])
    path = output or Path(f"{name}.yaml")
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"{path} has the suffix {path.suffix!r}; a scene file is .yaml: rename it")
    check_file_place(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; it is not overwritten: choose another --output")
    stated = MeshesConfig(**meshes)
    source = _source(files, path.parent, stated.robot_meshes)
    if source.lost and report is None:
        raise ValueError(
            f"{source.lost[0]}, or let `mereo scene new {shlex.join(map(str, files))} --output object.yaml` write a "
            "scene file without it, and name that"
        )
    text, notes = _draft(name, source, stated, aperture)
    write_file(path, text, force=False)
    if report is not None:
        for note in (*(f"left out: {text}" for text in source.lost), *source.notes, *notes):
            report(note)
    return path


def identifier(text: str) -> str:
    """Valid scene name, made of ``text``, that no built-in scene has."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-._") or "object"
    return f"my-{name}" if name in SCENES else name


def _source(files: Sequence[Path], folder: Path, robot_meshes: RobotMeshes) -> _Source:
    relative = [Path(os.path.relpath(file, folder)).as_posix() for file in files]
    for file, text in zip(files, relative, strict=True):
        if text != text.encode("utf-8", "replace").decode():
            raise ValueError(f"{file} has a name that is not UTF-8; a scene file is text in UTF-8: rename it")
    if volumes := [file for file in files if is_volume(file)]:
        if others := [file for file in files if file not in volumes]:
            raise ValueError(
                f"{volumes[0]} is a label volume and {others[0]} is none; an object is of one kind: name label volumes "
                "alone, or meshes alone"
            )
        return _from_volumes(files, relative)
    if robots := [file for file in files if is_robot(file)]:
        if len(files) > 1:
            raise ValueError(f"{robots[0]} is a whole robot, and other files are named too: name it alone")
        robot = read_robot(files[0], robot_meshes)
        links = "the links of a robot, where all of its joints are zero"
        links += f"\nrobot_meshes: {robot_meshes}  # of the links: visual, or collision"
        notes = (*robot.notes, *_overlap_note(robot.mesh))
        source = _from_model(files[0], relative[0], robot.mesh, links)
        return source._replace(robot=robot.joints, notes=notes)
    meshes = [read_object_file(file, robot_meshes) for file in files]
    if len(files) == 1 and len(meshes[0].segments) > 1:
        return _from_model(files[0], relative[0], meshes[0])
    # one segment for each file, called after it, with all of its parts
    names = _segment_names([file.stem for file in files], "files")
    parts = [Segment(name, PALETTE[0], *mesh.merged()[:2]) for name, mesh in zip(names, meshes, strict=True)]
    mesh = SegmentedMesh(tuple(parts))
    lines = ["segments:  # one closed mesh for each; their order is that of the labels"]
    for number, (name, text) in enumerate(zip(names, relative, strict=True)):
        color = list(palette_color(number))
        lines += [f"  - name: {quoted(name)}", f"    file: {quoted(text)}", f"    color: {color}"]
    lines.append("    # nested_in: NAME  # for a segment that lies inside another one, which has to come after it")
    return _Source("\n".join(lines), mesh, *_likely_frame(files[0], mesh.bounds))


def _segment_names(names: Sequence[str], kind: str) -> Names:
    """Names of segments after those of files or parts; raises ``ValueError`` where two of them are the same."""
    valid = tuple(_segment_name(name) for name in names)
    if repeated := sorted({name for name in valid if valid.count(name) > 1}):
        raise ValueError(f"two {kind} are called {repeated[0]!r}; segments are named after them: rename one of them")
    return valid


def _segment_name(text: str) -> str:
    """Text with an underscore for each character that a segment's name cannot have."""
    return "".join(each if each.isprintable() and each not in "/\\" else "_" for each in text)


def _overlap_note(mesh: SegmentedMesh) -> list[str]:
    """Sentence about links that overlap at rest, as the links of mechanisms may; none where they do not."""
    pairs = overlaps(mesh) if all(examine(segment).sound for segment in mesh.segments) else ()
    return [f"overlap: where all joints are zero, {listed(map(str, pairs))}; links may"] if pairs else []


def _from_model(file: Path, relative: str, mesh: SegmentedMesh, what: str = "") -> _Source:
    lines = [
        f"model: {quoted(relative)}{what and f'  # {what}'}",
        "parts:  # delete what is not wanted; their order is that of the labels",
    ]
    names = _segment_names(mesh.names, "parts")
    for number, (part, name) in enumerate(zip(mesh.names, names, strict=True)):
        lines.append(f"  - name: {quoted(name)}")
        lines += [f"    parts: [{quoted(part)}]"] if part != name else []
        lines.append(f"    color: {list(palette_color(number))}")
    mesh = SegmentedMesh(tuple(replace(part, name=name) for part, name in zip(mesh.segments, names, strict=True)))
    lines.append("    # parts: [A, B]  # parts of the model to join into this segment, instead of the one of its name")
    return _Source("\n".join(lines), mesh, *_likely_frame(file, mesh.bounds))


def _from_volumes(files: Sequence[Path], relative: Sequence[str]) -> _Source:
    with warnings.catch_warnings(record=True) as empty:
        warnings.simplefilter("always", LabelWarning)
        volume = read_label_volume(*files)
    if not volume.values:
        raise ValueError(f"{files[0]} holds only empty space; a label volume has values above 0: export it again")
    names = {value: _segment_name(volume.names.get(value, f"label_{value}")) for value in volume.values}
    thin = Texts()
    try:
        mesh, cells, losses = _surfaces(volume, names)
    except ThinSegmentError as error:
        thin = error.thin
        kept = {value: name for value, name in names.items() if name not in thin}
        if not kept:
            raise
        mesh, cells, losses = _surfaces(volume, kept)
    listed = quoted(relative[0]) if len(files) == 1 else f"[{', '.join(map(quoted, relative))}]"
    lines = [f"labels: {listed}", "names:  # of the volume's values; delete what is not wanted"]
    lines += [f"  {'# ' if name in thin else ''}{value}: {quoted(name)}" for value, name in names.items()]
    lines.append(f"cells: {cells}  # of the grid along the longest side on which surfaces are found")
    notes = [str(warning.message) for warning in (*empty, *losses)]
    notes += [f"nested: {inner} in {outer}" for inner, outer in mesh.nested]
    facts = ("mm", "the convention of NIfTI and NRRD", 2, "z is to the head", False)
    return _Source("\n".join(lines), mesh, *facts, tuple(thin.values()), tuple(notes))


def _surfaces(
    volume: LabelVolume, names: Mapping[int, str]
) -> tuple[SegmentedMesh, int, list[warnings.WarningMessage]]:
    """Surfaces on the coarsest grid of ``LABEL_CELLS`` that holds all, its cells, and what is lost on it.

    Raises ``ThinSegmentError`` where none does.
    """
    thin = Texts()
    for cells in LABEL_CELLS:
        with warnings.catch_warnings(record=True) as losses:
            warnings.simplefilter("always", LabelWarning)
            try:
                return segment_surfaces(volume, names, cells), cells, losses
            except ThinSegmentError as error:
                thin = error.thin
    raise ThinSegmentError(thin)


def _likely_frame(file: Path, bounds: Corners) -> tuple[str, str, int, str]:
    """Unit of a mesh file, and why; the axis that points upwards in it, and why."""
    kind = file.suffix.lower().lstrip(".")
    guess = likely_unit(bounds)
    longest_m = longest_side(bounds) * UNITS_M[guess]
    robots = dict.fromkeys((suffix[1:] for suffix in ROBOT_SUFFIXES), ("m", "the rule of robots' files"))
    known = robots | {
        "glb": ("m", "the rule of glTF"),
        "gltf": ("m", "the rule of glTF"),
        "3mf": ("mm", "the default of 3MF"),
        "dae": ("m", "as it is read by the unit that it states"),
    }
    unit, reason = known.get(kind, (guess, f"guessed: the object would be {longest_m:.3g} m long"))
    up = 1 if kind in ("glb", "gltf", "obj") else 2
    return unit, reason, up, f"{'xyz'[up]} is up, as in most files of the kind .{kind}"


# --- the text ---------------------------------------------------------------------------------------------------------


def _draft(name: str, source: _Source, meshes: MeshesConfig, aperture: float) -> tuple[str, list[str]]:
    """Text of a scene file, and sentences about what it proposes."""
    sides = np.ptp(source.mesh.bounds, axis=0)
    way = meshes.deformations
    size = rounded(min(SIZE, LONGEST * float(sides.min() / sides.max())), 3)
    placement = placed(source.mesh, size)
    robot = [_robot_block(joint) for joint in source.robot or ()]
    joints = proposed_joints(source.mesh) if source.assembly and source.robot is None else ()
    if source.robot is not None and way in ("auto", "articulated", "rigid"):  # its links are rigid
        way = "articulated" if robot else "rigid"
        why = "as the file says"
    else:
        way, why = _chosen(way, joints)
    motion = {"soft": SOFT, "stiff": STIFF}.get(way)
    moves = _Moves(way, joints, () if motion is None else default_deformations(source.mesh, motion), robot)
    rest = source.mesh.with_vertices([placement.apply(segment.vertices) for segment in source.mesh.segments])
    x, y, z = np.eye(3)[source.up].tolist()
    up_reason = source.up_reason
    base = flat_base(source.mesh, (x, y, z)) if source.assembly else None
    if base is not None:
        up_reason, (x, y, z) = "it stands on its flat base", [rounded(value, 3) for value in -base.normal]
    workspace = Workspace(radians(aperture), axis=(x, y, z), any_roll=aperture == 360.0)
    near, far, view = _default_view(rest, moves.draw(rest, placement), workspace)
    unit, reason = (meshes.units, "as you said") if meshes.units else (source.unit, source.reason)
    text = TEMPLATE.format(
        name=quoted(name),
        block=source.block,
        unit=unit,
        reason=reason,
        up_reason=up_reason,
        size=size,
        cone=aperture,
        near=near,
        far=far,
        sides=" x ".join(f"{side:.4g}" for side in sides),
        up=_numbers(np.array((x, y, z))),
        roll="true" if workspace.any_roll else "false",
        view=view,
        deformations=_deformations(source.mesh, moves),
    )
    notes = [f"deformations: {moves.describe()}, {why}", *_notes(source.mesh, moves)]
    return text, notes if base is None else [*notes, f"base: {base.describe(workspace)}"]


def _chosen(way: Way, joints: Sequence[Joint]) -> tuple[Way, str]:
    """How an object deforms, and why; ``ValueError`` where it is to be articulated and has no joints."""
    if way == "auto":
        if hinges := sum(joint.hinge for joint in joints):
            return "articulated", f"for its parts touch like {counted(hinges, 'hinge')}"
        return "soft", "for its parts touch in planes alone" if joints else "for no parts of it touch like a hinge"
    if way == "articulated" and not joints:
        raise ValueError(
            "the object is to be articulated, and no parts of it touch as in a joint: take soft, stiff or rigid, and "
            "write its joints into the scene file by hand"
        )
    return way, "as you said"


class _Moves(NamedTuple):
    """How the object of a new scene file moves: joints that its contacts suggest, and blocks that move all segments."""

    way: Way
    joints: Sequence[Joint]
    blocks: Blocks
    robot: Sequence[JsonObject] = ()

    def describe(self) -> str:
        if not self.blocks:
            return "by its joints" if self.way == "articulated" else "none"
        if not isinstance(self.blocks[0], ElasticBlock):
            return "as in a box of rubber, for its segments do not touch"
        return f"as a {self.way} elastic solid"

    def draw(self, rest: SegmentedMesh, placement: Normalizer) -> RandomMotion:
        """Random motion of the segments, placed already, in scene units."""
        if self.way != "articulated":
            return random_motion(rest, self.blocks, placement)
        target = Target(rest, rest.bounds, placement)
        if self.robot:
            index = {name: number for number, name in enumerate(rest.names)}
            samplers = (JointBlock.model_validate(block).sampler(target) for block in self.robot)
            moved = (tuple(index[name] for name in block["segments"]) for block in self.robot)
            return RandomMotion(rest, tuple(zip(samplers, moved, strict=True)))
        return RandomMotion(rest, tuple((_joint_block(joint).sampler(target), joint.moved) for joint in self.joints))


def _joint_block(joint: Joint) -> JointBlock:
    (x, y, z), (u, v, w) = joint.contact.point.tolist(), joint.axis.tolist()
    angle, slide = (joint.most, (0.0, 0.0)) if joint.hinge else ((0.0, 0.0), joint.most)
    return JointBlock(type="joint", pivot=(x, y, z), axis=(u, v, w), angle=angle, slide=slide)


def _robot_block(joint: RobotJoint) -> JsonObject:
    """Block of a joint of a robot's file."""
    limits = np.rad2deg(joint.limits) if joint.turns else np.array(joint.limits)
    numbers = {"pivot": joint.pivot, "axis": joint.axis, "angle" if joint.turns else "slide": limits}
    names = {"name": joint.name, "follows": joint.follows}
    return {
        "type": "joint",
        **{key: _segment_name(name) for key, name in names.items() if name},
        "segments": [_segment_name(name) for name in joint.moved],
        **{key: [rounded(value, EXACT) for value in values.tolist()] for key, values in numbers.items()},
    }


def _notes(mesh: SegmentedMesh, moves: _Moves) -> list[str]:
    """Sentences about proposed joints."""
    ending = "" if moves.way == "articulated" else ", proposed in comments: remove the # where it has them"
    count = counted(len(moves.joints), "joint")
    notes = [f"joints: its parts touch like {count}{ending}"] if moves.joints else []
    for joint in moves.joints:
        if joint.narrowed:
            names = ", ".join(mesh.names[index] for index in joint.moved)
            way = "turns by" if joint.hinge else "slides by"
            notes.append(f"  {names} {way} {_range(joint.most)}, {_narrowed(joint)}")
    return notes


def _narrowed(joint: Joint) -> str:
    """Why the range of a joint is less than it could be by itself."""
    return f"narrowed from {_range(joint.alone)}: beyond, joints collide together"


def _deformations(mesh: SegmentedMesh, moves: _Moves) -> str:
    """The key ``deformations`` with its lines: joints, what bends the whole, and others in comments."""
    (start, longest, length), joints = _longest_side(mesh), _joints(mesh, moves.joints)
    end = _numbers(start)
    axis = np.eye(3, dtype=int)[longest].tolist()
    shortest = np.ptp(mesh.bounds, axis=0).min()
    further = FURTHER.format(end=end, axis=axis, length=rounded(length), push=0.1 * shortest, reach=0.5 * shortest)
    if moves.way == "rigid":
        return f"deformations: rigid\n{joints}{further}"
    if moves.way == "articulated" and moves.robot:
        return f"{ROBOT}\ndeformations:\n{indent(_yaml(moves.robot), '  ')}{ELASTIC_COMMENT}{further}"
    if moves.way == "articulated":
        lines = [line.removeprefix("#") for line in joints.splitlines(keepends=True)[1:]]
        return f"{ARTICULATED}\ndeformations:\n{''.join(lines)}{ELASTIC_COMMENT}{further}"
    return f"deformations:\n{joints}{_soft(mesh, moves.blocks)}{further}"


def _soft(mesh: SegmentedMesh, blocks: Blocks) -> str:
    """Lines of what bends the whole object."""
    if isinstance(blocks[0], ElasticBlock):
        vertices = mesh.merged()[0]
        longest = int(np.ptp(mesh.bounds, axis=0).argmax())
        return ELASTIC_TEXT.format(
            motion=blocks[0].motion,
            soft=SOFT,
            stiff=STIFF,
            part=quoted(mesh.names[-1]),
            end=_numbers(vertices[vertices[:, longest].argmin()]),
            held=0.15 * longest_side(mesh.bounds),
        )
    bend, lattice = blocks[0], blocks[-1]
    assert isinstance(bend, BendBlock) and isinstance(lattice, LatticeBlock)
    end = _numbers(np.array(bend.origin))
    axis = [int(value) for value in bend.axis]
    return RUBBER.format(lattice=lattice, end=end, axis=axis, length=bend.length, angle=bend.angle[1])


def _joints(mesh: SegmentedMesh, joints: Sequence[Joint]) -> str:
    """Comments: the joints that the parts seem to have, and what each was derived from; else an example."""
    lines = list[str]()
    for joint in joints:
        contact = joint.contact
        kind = f"the round contact, radius {contact.radius:.3g}," if joint.hinge else "the flat contact"
        lines += [
            f"{TURNS_ON if joint.hinge else SLIDES_ALONG} {kind} of {mesh.names[contact.first]} and "
            f"{mesh.names[contact.second]}",
            f"#    segments: [{', '.join(quoted(mesh.names[index]) for index in joint.moved)}]",
            f"#    pivot: {_numbers(contact.point)}",
            f"#    axis: {_numbers(joint.axis)}",
            f"#    {'angle' if joint.hinge else 'slide'}: {_range(joint.most)}"
            + (f"  # {_narrowed(joint)}" if joint.narrowed else ""),
        ]
    if not lines:
        return EXAMPLE_JOINT.format(part=quoted(mesh.names[-1]), center=_numbers(mesh.bounds.mean(axis=0)))
    return "".join(line + "\n" for line in (JOINTS, *lines))


def _range(values: Range) -> str:
    return f"[{values[0]:.4g}, {values[1]:.4g}]"


def _yaml(blocks: Sequence[Facts]) -> str:
    """Blocks as YAML, their lists on a line each."""
    return yaml.safe_dump(
        list(blocks), sort_keys=False, allow_unicode=True, default_flow_style=None, width=float("inf")
    )


def quoted(text: str) -> str:
    """Text as a YAML value on one line, also within a list: quoted and escaped where it would not be this text."""
    listed = yaml.safe_dump([text], default_flow_style=True, allow_unicode=True, width=float("inf"))
    return listed.strip()[1:-1]


def _numbers(values: Vector) -> str:
    largest = max(float(np.abs(values).max()), 1e-12)  # what is nothing compared with it is rounding
    return "[" + ", ".join(f"{value if abs(value) > 1e-4 * largest else 0.0:.4g}" for value in values) + "]"


JOINTS = "# Joints that the contacts suggest, in ranges without collisions; remove the '#'. The tip comes first:"

ARTICULATED = "# Joints that the contacts suggest, in ranges without collisions. The tip comes first."

ROBOT = "# Joints of the robot's file, by its names and within its limits. The tip comes first."

EXACT = 8
"""Digits of numbers that a robot's file gives exactly."""

EXAMPLE_JOINT = """\
#  - type: joint  # rigid, and before what bends the whole; in a chain, the joint at the tip comes first
#    segments: [{part}]
#    pivot: {center}
#    axis: [0, 0, 1]
#    angle: [-30, 30]
"""

ELASTIC_TEXT = """\
  - type: elastic  # all segments as one solid under random loads
    motion: {motion:g}  # of a typical place, in half longest sides: {soft:g} is soft, as organs are, {stiff:g} is stiff
#    stiffness: {{{part}: 10}}  # of a segment, in that of the others
#    held:  # what does not move, such as an attachment: a ball, or a side of a plane (direction instead of radius)
#      - center: {end}
#        radius: {held:.3g}
"""

ELASTIC_COMMENT = """\
#  - type: elastic  # bends the whole as well
#    motion: 0.025
"""

RUBBER = """\
  - type: bend  # along the longest side, to any side
    origin: {end}
    axis: {axis}
    length: {length:g}
    angle: [-{angle:g}, {angle:g}]
  - type: lattice  # smooth and free-form: the object in a box of rubber
    spacing: {lattice.spacing:g}  # of the points that are moved: wider is smoother
    strength: {lattice.strength:g}  # from 0 to below 1, at which space might fold over
  - type: lattice  # once more, for one alone is stiffer than rubber
    spacing: {lattice.spacing:g}
    strength: {lattice.strength:g}
"""

FURTHER = """\
#  - type: twist
#    origin: {end}
#    axis: {axis}
#    length: {length:g}
#    angle: [-30, 30]
#  - type: squash  # along a random axis, with the volume kept
#    factor: [0.9, 1.1]
#  - type: waves
#    wavelength: [{length:g}, {length:g}]
#    strength: 0.3
#  - type: push  # an instrument pulls (above 0) or presses (below 0) at a random place
#    distance: [-{push:.3g}, {push:.3g}]
#    tip: {push:.3g}
#    reach: {reach:.3g}
"""

TEMPLATE = """\
# A scene for mereo: what the object is, how it may deform, and from where it is seen.
# Lengths and places are those of the files, angles are degrees, a range is [least, most].
# Every key is explained in docs/scene-file.md.

name: {name}
units: {unit}  # {reason}. mm, cm, m, in, or metres per unit
source: my own  # where the meshes come from, and their licence; kept with datasets and weights

# The object is {sides} {unit}. Paths are relative to this file.
{block}

# Scene units, in which networks see the object: its shortest side is this long. The camera's noise is 0.1 of them.
size: {size:g}

camera:
  aperture: {cone:g}  # of the cone of directions from which the camera looks: 360 is all around, 180 never from below
  axis: {up}  # the middle of that cone, as seen from the object: above it, where {up_reason}
  distance: [{near:g}, {far:g}]  # from the object's centre, in scene units
  roll: {roll}  # whether the camera may be rolled about its line of sight
  field_of_view: {view}  # as narrow as still shows all of the object at the nearest distance

# Drawn at random within these bounds for every example, and applied in this order to the segments named, or to all.
# Segments that touch should move by the same deformations, so that they stay in contact. One word says them too:
# rigid, soft or stiff (an elastic solid).
{deformations}# Recorded frames of a simulator take the place of all deformations:
#states: states.npz
"""
