"""First draft of a scene file, for an object of which only the meshes are known: ``mereo scene new``.

The object is taken for rubber that deforms about as much as those of the built-in scenes. A lattice alone is too stiff
for that: the bound that keeps space from folding over limits it. So the object bends along its longest side, and two
lattices of cubes follow, one after the other, all scaled until the surface moves by ``MOTION``.
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float, Int

from mereo.deformation.maps import Deformation
from mereo.deformation.samplers import RandomMotion, distance_from_line
from mereo.geometry.conventions import UNITS_M
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh, surface_points
from mereo.geometry.mesh_check import likely_unit
from mereo.geometry.transforms import Normalizer, fit_rigid, inverse_rigid, transform_points
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.volume_files import is_volume, read_label_volume, segment_surfaces
from mereo.scenes.files.deformation_blocks import BendBlock, DeformationBlock, LatticeBlock, Target
from mereo.scenes.files.joints import SLIDES_ALONG, TURNS_ON, proposed_joints
from mereo.scenes.scene import SCENES, Workspace
from mereo.scenes.seeds import example_rng

# --- how far states move ----------------------------------------------------------------------------------------------

# How far an object moves in its random states: what its shape changes by, beyond turns and shifts of the whole.

STATES = 24

POINTS = 800
"""Places of the surface at which motion is measured."""

Draw = Callable[[np.random.Generator], tuple[Deformation, ...]]


@dataclass(frozen=True)
class Motion:
    """Motion of the surface in a typical (median) state, in shares of the object's longest side.

    Attributes:
        mean: root mean square over the surface, after the best rigid motion of the whole.
        largest: that of the place which moves farthest, likewise.
    """

    mean: float
    largest: float


def motion(rest: SegmentedMesh, draw: Draw, states: int = STATES) -> Motion:
    """Motion of an object in ``states`` random states, which are the same in every call."""
    points, owner = material_points(rest, POINTS)
    length = float((rest.bounds[1] - rest.bounds[0]).max())
    means, most = [], []
    for index in range(states):
        moved = move(points, owner, draw(example_rng(0, index)))
        way = np.linalg.norm(moved - transform_points(fit_rigid(points, moved), points), axis=1) / length
        means.append(np.sqrt(np.mean(way**2)))
        most.append(way.max())
    return Motion(float(np.median(means)), float(np.median(most)))


def move(
    points: Float[np.ndarray, "n 3"], owner: Int[np.ndarray, " n"], deformations: tuple[Deformation, ...]
) -> Float[np.ndarray, "n 3"]:
    """Points of segments (indices ``owner``), each moved by its segment's map."""
    result = np.empty_like(points)
    for index in np.unique(owner):
        rows = owner == index
        result[rows] = deformations[index](points[rows])
    return result


def material_points(mesh: SegmentedMesh, count: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Points evenly spread over the surface of all segments, and the index of the segment of each."""
    vertices, faces, owner = mesh.merged()
    points, face = surface_points(vertices, faces, count)
    return points, owner[face]


# --- defaults ---------------------------------------------------------------------------------------------------------

MOTION = 0.05
"""Motion of the surface in a typical state, in longest sides: that of the bunny and of the liver."""

LATTICES = 2

MOST_STRENGTH = 0.9

MOST_BEND_DEG = 120.0

BEND_SHARE = 0.8
"""Largest bend, as a share of that at which space folds over; ``samplers.FOLD_SHARE`` is the bound."""

NEAR = 100.0
"""Nearest distance of the camera, as in the paper, in scene units; farther for what would fill a wider view."""

FARTHER = 1.25
"""Farthest distance, in nearest ones. Twice, as in the paper, leaves a quarter of the picture's pixels."""

MOST_VIEW_RAD = float(np.deg2rad(40.0))

VIEWS = 64

FRAMED = 1000
"""Places of the surface that a view must show, and at most so many vertices of each segment."""

MARGIN = 1.03
"""Width of the picture, in widths of the widest of ``VIEWS`` views from the nearest distance."""


UNPLACED = Normalizer(np.zeros(3), 1.0)


def default_deformations(mesh: SegmentedMesh) -> tuple[BendBlock | LatticeBlock, ...]:
    """Deformations under which the surface moves by about ``MOTION``, or by as much as does not fold space over.

    Args:
        mesh: segments in the file's frame and unit.
    """
    strength = 1.0
    for _ in range(4):  # motion is nearly proportional to the strength
        blocks = _blocks(mesh, strength)
        moved = motion(mesh, random_motion(mesh, blocks, UNPLACED)).mean
        if abs(moved / MOTION - 1) < 0.02 or (moved < MOTION and strength == 1.0):
            break
        strength = min(strength * MOTION / moved, 1.0)
    return _blocks(mesh, strength)


def _blocks(mesh: SegmentedMesh, strength: float) -> tuple[BendBlock | LatticeBlock, ...]:
    """A bend along the longest side and ``LATTICES`` lattices, numbers rounded as they are written."""
    low, high = mesh.bounds
    longest = int((high - low).argmax())
    origin, axis, length = (low + high) / 2, np.eye(3)[longest], float((high - low)[longest])
    origin[longest] = low[longest]
    radius = distance_from_line(mesh.merged()[0], origin, axis)
    most = min(BEND_SHARE * np.rad2deg(length / radius), MOST_BEND_DEG)
    x, y, z = (rounded(value) for value in origin)
    angle, size = float(np.floor(most * strength)), rounded(length)
    share = rounded(MOST_STRENGTH * strength, 2)
    bend = BendBlock(type="bend", origin=(x, y, z), axis=_direction(longest), length=size, angle=(-angle, angle))
    return (bend, *(LATTICES * [LatticeBlock(type="lattice", spacing=rounded(length / 2), strength=share)]))


def _direction(index: int) -> tuple[float, float, float]:
    x, y, z = np.eye(3)[index]
    return float(x), float(y), float(z)


def rounded(value: float, digits: int = 4) -> float:
    """Value with so many digits that count."""
    return float(f"{value:.{digits}g}")


def random_motion(mesh: SegmentedMesh, blocks: tuple[DeformationBlock, ...], placement: Normalizer) -> RandomMotion:
    """Maps that blocks draw for all segments of a mesh, which is placed already."""
    everything = tuple(range(len(mesh.segments)))
    target = Target(mesh, mesh.bounds, placement)
    return RandomMotion(mesh, tuple((block.sampler(target), everything) for block in blocks))


# --- the camera -------------------------------------------------------------------------------------------------------


def _default_view(rest: SegmentedMesh, draw: Draw, workspace: Workspace) -> tuple[float, float, int]:
    """Nearest and farthest distance in scene units, and field of view in degrees, that random states fill uncut."""
    states = _states(rest, draw)
    reach = max(float(np.linalg.norm(points - center, axis=1).max()) for points, center in states)
    near = max(NEAR, float(np.ceil(reach / np.sin(MOST_VIEW_RAD / 2))))
    widest = 0.0
    for index, (points, center) in enumerate(states):
        pose = workspace.sample(example_rng(1, index), center)
        pose[:3, 3] = center - near * pose[:3, 2]
        seen = transform_points(inverse_rigid(pose), points)
        widest = max(widest, float(np.abs(seen[:, :2] / seen[:, 2:]).max()))
    view = int(np.clip(np.ceil(np.rad2deg(2 * np.arctan(MARGIN * widest))), 5, 90))
    return near, float(np.ceil(FARTHER * near)), view


def _states(rest: SegmentedMesh, draw: Draw) -> list[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "3"]]]:
    """Places of the surface in random states, and the middle of their box, at which the camera aims."""
    points, owner = material_points(rest, FRAMED)
    corners = [segment.vertices[:: 1 + len(segment.vertices) // FRAMED] for segment in rest.segments]
    owner = np.concatenate([owner, np.repeat(np.arange(len(corners)), [len(part) for part in corners])])
    points = np.concatenate([points, *corners])
    moved = [move(points, owner, draw(example_rng(0, index))) for index in range(VIEWS)]
    return [(places, (places.min(axis=0) + places.max(axis=0)) / 2) for places in moved]


def placed(mesh: SegmentedMesh, size: float) -> Normalizer:
    """Map from the file's frame to the scene's: the joint box centred, its shortest side ``size`` long."""
    low, high = mesh.bounds
    shortest = float((high - low).min())
    if not shortest > 0:
        raise ValueError(f"the object's box has sides {(high - low).tolist()}; all must be above 0: check the meshes")
    return Normalizer((low + high) / 2, size / shortest)


# --- the file ---------------------------------------------------------------------------------------------------------

SIZE = 20.0
"""Shortest side in scene units, as in the paper, unless the object is longer than ``LONGEST`` then."""

LONGEST = 80.0

LABEL_CELLS = 64


@dataclass(frozen=True, eq=False)
class _Source:
    """Segments of files in their unit, the lines that name them, and the likely unit and upward axis, with reasons.

    ``assembly`` is whether the segments are parts, which may have joints, and not regions of one body.
    """

    block: str
    mesh: SegmentedMesh
    unit: str
    reason: str
    up: int
    up_reason: str
    assembly: bool = True


def write_scene_file(
    files: Sequence[Path], output: Path | None = None, units: str | None = None, name: str | None = None
) -> Path:
    """Write a commented YAML file that names ``files`` relative to itself; returns its path.

    Args:
        files: one mesh for each segment, one file of named parts, or one label volume.
        output: by default ``NAME.yaml`` in the working directory, after the first file.
        units: a key of ``geometry.conventions.UNITS_M``; None guesses.
        name: of the scene; by default that of ``output``.

    Raises ``FileExistsError`` where ``output`` exists, ``ValueError`` and ``FileNotFoundError`` for unusable files.
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
    source = _source(list(files), path.parent)
    with atomic_file(path, force=False) as temporary:
        temporary.write_text(_text(name, source, units), encoding="utf-8")
    return path


def identifier(text: str) -> str:
    """Valid scene name, made of ``text``, that no built-in scene has."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-._") or "object"
    return f"my-{name}" if name in SCENES else name


def _source(files: list[Path], folder: Path) -> _Source:
    relative = [Path(os.path.relpath(file, folder)).as_posix() for file in files]
    for file, text in zip(files, relative, strict=True):
        if text != text.encode("utf-8", "replace").decode():
            raise ValueError(f"{file} has a name that is not UTF-8; a scene file is text in UTF-8: rename it")
    if any(is_volume(file) for file in files):
        if len(files) > 1:
            raise ValueError(
                f"{len(files)} files are given, with a label volume among them; it comes alone: name it only"
            )
        return _from_volume(files[0], relative[0])
    if len(files) > 1:
        return _from_meshes(files, relative)
    mesh = read_segmented_mesh(files[0])
    return _from_meshes(files, relative) if len(mesh.segments) == 1 else _from_model(files[0], relative[0], mesh)


def _from_meshes(files: Sequence[Path], relative: Sequence[str]) -> _Source:
    """One segment for each file, called after it, with all of its parts."""
    names = _segment_names([file.stem for file in files], "files")
    mesh = SegmentedMesh(tuple(_whole_file(name, file) for name, file in zip(names, files, strict=True)))
    lines = ["segments:  # one closed mesh for each; their order is that of the labels"]
    for number, (name, file) in enumerate(zip(names, relative, strict=True)):
        lines += [f"  - name: {quoted(name)}", f"    file: {quoted(file)}", f"    color: {_color(number)}"]
    lines.append("    # nested_in: NAME  # for a segment that lies inside another one, which has to come after it")
    return _Source("\n".join(lines), mesh, *_unit_of(files[0], mesh.bounds), *_up_of(files[0]))


def _segment_names(names: Sequence[str], kind: str) -> tuple[str, ...]:
    """Names of segments after those of files or parts; raises ``ValueError`` where two of them are the same."""
    valid = tuple(_segment_name(name) for name in names)
    if repeated := sorted({name for name in valid if valid.count(name) > 1}):
        raise ValueError(f"two {kind} are called {repeated[0]!r}; segments are named after them: rename one of them")
    return valid


def _segment_name(text: str) -> str:
    """Text with an underscore for each character that a segment's name cannot have."""
    return "".join(each if each.isprintable() and each not in "/\\" else "_" for each in text)


def _whole_file(name: str, file: Path) -> Segment:
    """All parts of a file."""
    vertices, faces, _ = read_segmented_mesh(file).merged()
    return Segment(name, PALETTE[0], vertices, faces)


def _from_model(file: Path, relative: str, mesh: SegmentedMesh) -> _Source:
    lines = [f"model: {quoted(relative)}", "parts:  # delete what is not wanted; their order is that of the labels"]
    names = _segment_names(mesh.names, "parts")
    for number, (part, name) in enumerate(zip(mesh.names, names, strict=True)):
        lines.append(f"  - name: {quoted(name)}")
        lines += [f"    parts: [{quoted(part)}]"] if part != name else []
        lines.append(f"    color: {_color(number)}")
    mesh = SegmentedMesh(tuple(replace(part, name=name) for part, name in zip(mesh.segments, names, strict=True)))
    lines.append("    # parts: [A, B]  # parts of the model to join into this segment, instead of the one of its name")
    return _Source("\n".join(lines), mesh, *_unit_of(file, mesh.bounds), *_up_of(file))


def _from_volume(file: Path, relative: str) -> _Source:
    volume = read_label_volume(file)
    values = [int(value) for value in np.unique(volume.labels) if value > 0]
    if not values:
        raise ValueError(f"{file} holds only empty space; a label volume has values above 0: export it again")
    names = {value: _segment_name(volume.names.get(value, f"label_{value}")) for value in values}
    mesh = segment_surfaces(volume, names, LABEL_CELLS)
    lines = [f"labels: {quoted(relative)}", "names:  # of the volume's values; delete what is not wanted"]
    lines += [f"  {value}: {quoted(name)}" for value, name in names.items()]
    lines.append(f"cells: {LABEL_CELLS}  # of the grid along the longest side on which surfaces are found")
    return _Source("\n".join(lines), mesh, "mm", "the convention of NIfTI and NRRD", 2, "z is to the head", False)


def _unit_of(file: Path, bounds: Float[np.ndarray, "2 3"]) -> tuple[str, str]:
    if file.suffix.lower() in (".glb", ".gltf"):
        return "m", "the rule of glTF"
    if file.suffix.lower() == ".3mf":
        return "mm", "the default of 3MF"
    unit = likely_unit(bounds)
    longest_m = float((bounds[1] - bounds[0]).max()) * UNITS_M[unit]
    return unit, f"guessed: the object would be {longest_m:.3g} m long"


def _up_of(file: Path) -> tuple[int, str]:
    """Axis that points upwards in a mesh file, and why."""
    kind = file.suffix.lower().lstrip(".")
    if kind in ("glb", "gltf", "obj"):
        return 1, f"y is up, as in most files of the kind .{kind}"
    return 2, f"z is up, as in most files of the kind .{kind}"


# --- the text ---------------------------------------------------------------------------------------------------------


def _text(name: str, source: _Source, units: str | None) -> str:
    sides = np.ptp(source.mesh.bounds, axis=0)
    size = rounded(min(SIZE, LONGEST * float(sides.min() / sides.max())), 3)
    placement = placed(source.mesh, size)
    blocks = default_deformations(source.mesh)
    rest = source.mesh.with_vertices([placement.apply(segment.vertices) for segment in source.mesh.segments])
    x, y, z = np.eye(3)[source.up].tolist()
    near, far, view = _default_view(rest, random_motion(rest, blocks, placement), Workspace(axis=(x, y, z)))
    unit, reason = (units, "as you said") if units else (source.unit, source.reason)
    bend, lattice = blocks[0], blocks[-1]
    assert isinstance(bend, BendBlock) and isinstance(lattice, LatticeBlock)
    return TEMPLATE.format(
        name=quoted(name),
        block=source.block,
        unit=unit,
        reason=reason,
        sides=" x ".join(f"{side:.4g}" for side in sides),
        size=f"{size:g}",
        up=[int(k == source.up) for k in range(3)],
        up_reason=source.up_reason,
        near=f"{near:g}",
        far=f"{far:g}",
        view=view,
        spacing=f"{lattice.spacing:g}",
        strength=f"{lattice.strength:g}",
        end=_numbers(np.array(bend.origin)),
        axis=[int(value) for value in bend.axis],
        length=f"{bend.length:g}",
        angle=f"{bend.angle[1]:g}",
        joints=_joints(source.mesh, source.assembly),
        push=f"{0.1 * sides.min():.3g}",
        reach=f"{0.5 * sides.min():.3g}",
    )


def _joints(mesh: SegmentedMesh, assembly: bool) -> str:
    """Comments: the joints that the parts seem to have, and what each was derived from; else an example."""
    lines = list[str]()
    for joint in proposed_joints(mesh) if assembly else ():
        contact = joint.contact
        kind = f"the round contact, radius {contact.radius:.3g}," if joint.hinge else "the flat contact"
        lines += [
            f"{TURNS_ON if joint.hinge else SLIDES_ALONG} {kind} of {mesh.names[contact.first]} and "
            f"{mesh.names[contact.second]}",
            f"#    segments: [{', '.join(quoted(mesh.names[index]) for index in joint.moved)}]",
            f"#    pivot: {_numbers(contact.point)}",
            f"#    axis: {_numbers(joint.axis)}",
            f"#    {'angle' if joint.hinge else 'slide'}: {_range(joint.most)}"
            + (f"  # narrowed from {_range(joint.alone)}: beyond, joints collide together" if joint.narrowed else ""),
        ]
    if not lines:
        return EXAMPLE_JOINT.format(part=quoted(mesh.names[-1]), center=_numbers(mesh.bounds.mean(axis=0)))
    return "".join(line + "\n" for line in (JOINTS, *lines))


def _range(values: tuple[float, float]) -> str:
    return f"[{values[0]:.4g}, {values[1]:.4g}]"


def _color(number: int) -> str:
    return str(list(PALETTE[number % len(PALETTE)]))


def quoted(text: str) -> str:
    """Text as a YAML value on one line, also within a list: quoted and escaped where it would not be this text."""
    listed = yaml.safe_dump([text], default_flow_style=True, allow_unicode=True, width=float("inf"))
    return listed.strip()[1:-1]


def _numbers(values: Float[np.ndarray, "3"]) -> str:
    largest = max(float(np.abs(values).max()), 1e-12)  # what is nothing beside it is rounding
    return "[" + ", ".join(f"{value if abs(value) > 1e-4 * largest else 0.0:.4g}" for value in values) + "]"


JOINTS = "# Joints that the contacts suggest, in ranges without collisions; remove the '#'. The tip comes first:"

EXAMPLE_JOINT = """\
#  - type: joint  # rigid, and before what bends the whole; in a chain, the joint at the tip comes first
#    segments: [{part}]
#    pivot: {center}
#    axis: [0, 0, 1]
#    angle: [-30, 30]
"""

TEMPLATE = """\
# A scene for mereo: what the object is, how it may deform, and from where it is seen.
# Lengths and places are those of the files, angles are degrees, a range is [least, most].
# Every key is explained in docs/own-object.md.

name: {name}
units: {unit}  # {reason}. mm, cm, m, in, or metres per unit
source: my own  # where the meshes come from, and their licence; kept with datasets and weights

# The object is {sides} {unit}. Paths are relative to this file.
{block}

# Scene units, in which networks see the object: its shortest side is this long. The camera's noise is 0.1 of them.
size: {size}

camera:
  aperture: 140  # of the cone of directions from which the camera looks; 360 is all around
  axis: {up}  # the middle of that cone, as seen from the object: above it, where {up_reason}
  distance: [{near}, {far}]  # from the object's centre, in scene units
  roll: false  # whether the camera may be rolled about its line of sight
  field_of_view: {view}  # as narrow as still shows all of the object at the nearest distance

# Drawn at random within these bounds for every example, and applied in this order to the segments named, or to all.
# Segments that touch should move by the same deformations, so that they stay in contact. These bend the object as if it
# were of rubber, as far as suits soft things: for what has joints, drop them and say how its parts move.
deformations:
{joints}  - type: bend  # along the longest side, to any side
    origin: {end}
    axis: {axis}
    length: {length}
    angle: [-{angle}, {angle}]
  - type: lattice  # smooth and free-form: the object in a box of rubber
    spacing: {spacing}  # of the points that are moved: wider is smoother
    strength: {strength}  # from 0 to below 1, at which space might fold over
  - type: lattice  # once more, for one alone is stiffer than rubber
    spacing: {spacing}
    strength: {strength}
#  - type: twist
#    origin: {end}
#    axis: {axis}
#    length: {length}
#    angle: [-30, 30]
#  - type: squash  # along a random axis, with the volume kept
#    factor: [0.9, 1.1]
#  - type: waves
#    wavelength: [{length}, {length}]
#    strength: 0.3
#  - type: push  # an instrument pulls (above 0) or presses (below 0) at a random place
#    distance: [-{push}, {push}]
#    tip: {push}
#    reach: {reach}
# Recorded frames of a simulator take the place of all deformations:
#states: states.npz
"""
