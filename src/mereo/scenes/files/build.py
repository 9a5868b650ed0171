"""Scenes of your own, as YAML files: from the text to a ``Scene`` (docs/scene-file.md explains every key).

Document -validated-> SceneFile -read_segments-> SegmentedMesh in the file's unit -scaled-> Scene
"""

import hashlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.linalg import norm

from mereo.deformation.elastic import ElasticSampler
from mereo.deformation.maps import Deformation, Deformations
from mereo.deformation.samplers import RandomMotion
from mereo.geometry.conventions import Range
from mereo.geometry.mesh import Segment, SegmentedMesh, palette_color
from mereo.geometry.mesh_check import examine, united
from mereo.geometry.subdivision import TooManyFaces, split_edges
from mereo.geometry.transforms import NamedPoses, Normalizer, checked_pose, longest_side
from mereo.io.config import RobotMeshes, Space
from mereo.io.mesh_formats import MeshWarning
from mereo.io.robots import is_robot, read_object_file, read_robot
from mereo.io.simulation_states import files_of_states, frame_files
from mereo.io.volume_files import file_space, read_label_volume, segment_surfaces
from mereo.io.yaml_document import Document, similar
from mereo.scenes.files.deformation_blocks import (
    AnyDeformation,
    ElasticBlock,
    JointBlock,
    Misfit,
    ModelPart,
    PartLook,
    SceneFile,
    Target,
)
from mereo.scenes.files.template import default_deformations, placed
from mereo.scenes.recorded_states import load_states
from mereo.scenes.scene import SCENES, Draw, Scene, Workspace
from mereo.scenes.seeds import example_rng

SMALLEST = 1.0
"""Longest side in scene units at least."""

SOURCES = {"source", "segments", "model", "parts", "robot_meshes", "labels", "names", "cells"}
"""Keys that decide the meshes, which identify themselves, or nothing."""


def load(path: Path) -> Scene:
    """Scene of a YAML file.

    A mesh with holes or self-intersections is used with a ``MeshWarning``: the winding number decides what is inside.

    Raises ``ValueError`` and ``FileNotFoundError`` with file, line, value, rule and cure.
    """
    document = Document(path)
    file = read(document)
    return build(document, file, _with_warnings(document, read_segments(document, file)))


def read(document: Document) -> SceneFile:
    """Validated content of a scene file. Its name must not be a built-in scene's, which weights would confuse."""
    file = document.validated(SceneFile)
    if file.name in SCENES:
        raise document.error(("name",), f"`name` is {file.name!r}, which is a built-in scene: choose another name")
    return file


def files_of(path: Path) -> list[Path]:
    """The scene file, the meshes or volume that it names, and its recorded states, whether they exist or not."""
    file = read(Document(path))
    named = [path.parent / name for name in names_of_shapes(file)]
    if file.states is not None:
        states, mesh = _paths_of_states(path, file)
        named += [states, *files_of_states(states, mesh)]
    return [path, *named, *_files_of_solids(path, file)]


def names_of_shapes(file: SceneFile) -> list[str]:
    """Paths of the meshes or volumes of the segments, as the scene file has them."""
    labels = [file.labels] if isinstance(file.labels, str) else file.labels or []
    names = (*(part.file for part in file.segments or ()), file.model, *labels)
    return [name for name in names if name is not None]


def _files_of_solids(path: Path, file: SceneFile) -> list[Path]:
    """Files of the tetrahedra that elastic solids are made of, and of the points where they are held."""
    solids = [block for block in file.deformations or () if isinstance(block, ElasticBlock)]
    held = (place.points for block in solids for place in block.held or ())
    return [path.parent / name for name in (*(block.tetrahedra for block in solids), *held) if name is not None]


def _with_warnings(document: Document, mesh: SegmentedMesh) -> SegmentedMesh:
    """Mesh with segments that are no solids marked so, and one warning for each of them."""
    cure = f"repair it with `mereo scene check {document.path} --repair`"
    segments = []
    for segment in mesh.segments:
        health = examine(segment)
        if refusal := health.refusal(len(segment.faces)):
            raise ValueError(f"{document.path}: segment {segment.name!r} {refusal}: {cure}")
        if health.dirty:
            text = f"{document.path}: segment {segment.name!r} {' and '.join(health.dirty)}; the winding number "
            warnings.warn(text + f"decides what is inside it, which is slower: {cure}", MeshWarning, stacklevel=3)
        segments.append(replace(segment, solid=not health.dirty))
    return replace(mesh, segments=tuple(segments))


def build(document: Document, file: SceneFile, mesh: SegmentedMesh) -> Scene:
    """Scene of a mesh in the file's unit: scaled to ``size`` and centred, with its deformations."""
    placement = placed(mesh, file.size)
    if (longest := placement.scale * longest_side(mesh.bounds)) < SMALLEST:
        raise document.error(
            ("size",),
            f"`size` is {file.size:g}, which makes the object {longest:.3g} scene units long; {SMALLEST:g} is the "
            f"least, as the camera's noise is 0.1: raise it to {file.size * SMALLEST / longest:.3g} or more",
        )
    rest = mesh.with_vertices([placement.apply(segment.vertices) for segment in mesh.segments])
    nearest = file.camera.distance[0]
    radius = float(norm(np.ptp(rest.bounds, axis=0))) / 2
    if not nearest > radius:
        raise document.error(
            ("camera", "distance"),
            f"`distance` starts at {nearest:g}; the camera must stay outside the object, which reaches {radius:.3g} "
            "scene units from its centre: start farther away, or lower `size`",
        )
    workspace = file.camera.workspace()
    unit_m = file.units / placement.scale
    definition = file.model_dump_json(exclude=SOURCES)
    if file.states is not None:
        scene = _recorded(document, file, rest, placement, workspace)
        definition += _digest(files_of_states(*_paths_of_states(document.path, file)))
    else:
        blocks = file.deformations
        if blocks is None:
            blocks = list(_kept(default_deformations, _Keyed(_content(mesh), (mesh,))))
            definition += str([block.model_dump() for block in blocks])
        motions = _random_motion(document, placement, rest, blocks)
        if volumes := _files_of_solids(document.path, file):
            definition += _digest(volumes)
        key = f"{_content(rest)} {placement.matrix.tolist()} {definition}"
        rest = _kept(refined, _Keyed(key, (rest, motions)))
        scene = Scene(file.name, rest, replace(motions, rest=rest), workspace, file.source)
    return replace(
        scene,
        unit_m=unit_m,
        T_scene_source=placement.matrix,
        definition=definition,
        space=_space(document, file),
        link_frames=link_frames(document, file),
    )


def _space(document: Document, file: SceneFile) -> Space | None:
    """Anatomical frame that the files of the segments name; ``ValueError`` where they name two."""
    files = [document.path.parent / name for name in names_of_shapes(file)]
    spaces = {space: path for path in files if (space := file_space(path)) is not None}
    if len(spaces) > 1:
        raise ValueError(
            f"{spaces['LPS']} is in LPS and {spaces['RAS']} in RAS, by what they state; the files of an object share "
            "one frame: export them in one space"
        )
    return next(iter(spaces), None)


def link_frames(document: Document, file: SceneFile) -> NamedPoses:
    """Frames of segments: as they state them, or of a robot's file, of the first link of each; else none."""
    path = document.path.parent / (file.model or "")
    if file.model is None or not is_robot(path):
        return {part.name: checked_pose(part.frame) for part in file.segments or () if part.frame is not None}
    frames = read_robot(path, file.robot_meshes).link_frames
    if file.parts is None:
        return frames
    return {part.name: frames[(part.parts or [part.name])[0]] for part in file.parts}


# --- what takes most of the time of loading a scene, which one command does several times ----------------------------


@dataclass(frozen=True)
class _Keyed:
    """Arguments that are equal to others of the same key."""

    key: str
    arguments: tuple[Any, ...] = field(compare=False)


@lru_cache(maxsize=8)
def _kept(function: Callable[..., Any], keyed: _Keyed) -> Any:
    return function(*keyed.arguments)


def _content(mesh: SegmentedMesh) -> str:
    """Key of a mesh's exact content."""
    digest = hashlib.sha256(repr(mesh.nested).encode())
    for segment in mesh.segments:
        digest.update(repr((segment.name, segment.color, segment.solid, segment.vertices.shape)).encode())
        digest.update(np.ascontiguousarray(segment.vertices).tobytes())
        digest.update(np.ascontiguousarray(segment.faces).tobytes())
    return digest.hexdigest()


def _recorded(
    document: Document, file: SceneFile, rest: SegmentedMesh, placement: Normalizer, workspace: Workspace
) -> Scene:
    """A scene in the states of ``states``, whose coordinates are those of the meshes."""
    path, mesh = _paths_of_states(document.path, file)
    for place in (path, mesh):
        if place is not None and not place.exists() and not frame_files(place):
            name = place.relative_to(document.path.parent)
            raise document.error(("states",), f"`states` is {str(name)!r}, and {place} does not exist: check the path")
    x, y, z = -placement.scale * placement.center
    with document.named_at(("states",)):
        states = load_states(path, rest, mesh=mesh, scale=placement.scale, shift=(x, y, z), held_out=file.held_out)
    return states.scene(file.name, rest, workspace, file.source)


def _paths_of_states(path: Path, file: SceneFile) -> tuple[Path, Path | None]:
    """Where the recorded states of a scene file at ``path`` are, and their mesh at rest."""
    assert file.states is not None
    mesh = file.states.mesh
    return path.parent / file.states.positions, None if mesh is None else path.parent / mesh


def _digest(files: Sequence[Path]) -> str:
    """Digest of the files that say how an object moves: others are another scene."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as content:
            digest.update(file.name.encode() + hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()


def _random_motion(
    document: Document, placement: Normalizer, rest: SegmentedMesh, blocks: Sequence[AnyDeformation]
) -> RandomMotion:
    """All deformations of the file in their order."""
    steps = []
    names = list(rest.names)
    _check_joints(document, blocks)
    for index, block in enumerate(blocks):
        for name in block.segments or ():
            if name not in names:
                place = ("deformations", index, "segments")
                raise document.error(place, f"no segment is called {name!r}: {similar(name, names)}")
        members = tuple(i for i, name in enumerate(names) if block.segments is None or name in block.segments)
        moved = SegmentedMesh(tuple(rest.segments[i] for i in members))
        try:
            target = Target(moved, rest.bounds, placement, document.path.parent)
            steps.append((block.sampler(target), members))
        except Misfit as misfit:
            raise document.error(("deformations", index, misfit.key), str(misfit)) from None
    return RandomMotion(rest, tuple(steps))


def _check_joints(document: Document, blocks: Sequence[AnyDeformation]) -> None:
    """Raise ``ValueError`` where two joints have one name, or one follows what is no joint with a value of its own."""
    joints = {index: block for index, block in enumerate(blocks) if isinstance(block, JointBlock) and block.name}
    leaders = [str(joint.name) for joint in joints.values() if joint.follows is None]
    for index, joint in joints.items():
        if any(joint.name == other.name for before, other in joints.items() if before < index):
            message = f"two joints are called {joint.name!r}; results have their values by name: rename one of them"
            raise document.error(("deformations", index, "name"), message)
        if joint.follows is not None and joint.follows not in leaders:
            message = f"no joint that follows none is called {joint.follows!r}: {similar(joint.follows, leaders)}"
            raise document.error(("deformations", index, "follows"), message)


# --- segments ---------------------------------------------------------------------------------------------------------


def read_segments(document: Document, file: SceneFile) -> SegmentedMesh:
    """Segments of a scene file as they are in its meshes, unchecked and unscaled.

    Raises ``ValueError`` and ``FileNotFoundError`` with the line that names what cannot be had, ``ImportError`` naming
    the extra that a format needs.
    """
    folder = document.path.parent
    if file.segments is not None:
        meshes = [
            _read(document, ("segments", index, "file"), folder / part.file) for index, part in enumerate(file.segments)
        ]
        joined = [_joined(part, mesh.segments) for part, mesh in zip(file.segments, meshes, strict=True)]
        return _assembled(document, "segments", file.segments, joined)
    if file.model is not None:
        model = _read(document, ("model",), folder / file.model, file.robot_meshes)
        if file.parts is None:
            return model
        return _assembled(document, "parts", file.parts, _from_model(document, file.parts, model))
    assert file.labels is not None and file.names is not None, "the schema asks for both"
    with document.named_at(("labels",)):
        volume = read_label_volume(*(folder / name for name in names_of_shapes(file)))
        return segment_surfaces(volume, file.names, file.cells)


def _read(
    document: Document, place: Sequence[int | str], path: Path, robot_meshes: RobotMeshes = "visual"
) -> SegmentedMesh:
    """A mesh file; errors say which line names it."""
    with document.named_at(place):
        return read_object_file(path, robot_meshes)


def _from_model(document: Document, parts: Sequence[ModelPart], model: SegmentedMesh) -> list[Segment]:
    segments = []
    for index, part in enumerate(parts):
        wanted = part.parts or [part.name]
        if missing := [name for name in wanted if name not in model.names]:
            raise document.error(
                ("parts", index), f"the model has no part {missing[0]!r}: {similar(missing[0], list(model.names))}"
            )
        segments.append(_joined(part, [model.segments[model.names.index(name)] for name in wanted]))
    return segments


def _joined(part: PartLook, pieces: Sequence[Segment]) -> Segment:
    """One segment of all pieces: their union where each is a solid that faces outwards, else all of their faces."""
    return Segment(part.name, pieces[0].color, *united(pieces))


def _assembled(document: Document, key: str, parts: Sequence[PartLook], segments: Sequence[Segment]) -> SegmentedMesh:
    """The segments with the file's colours and nesting."""
    names = [part.name for part in parts]
    for index, part in enumerate(parts):
        if part.nested_in is not None and part.nested_in not in names:
            raise document.error(
                (key, index, "nested_in"), f"no segment is called {part.nested_in!r}: {similar(part.nested_in, names)}"
            )
    nested = tuple((part.name, part.nested_in) for part in parts if part.nested_in is not None)
    colors = [segment.color for segment in segments]
    if len(set(colors)) < len(colors):  # the meshes' own do not tell the segments apart
        colors = [palette_color(index) for index in range(len(colors))]
    colored = (
        replace(segment, color=part.color or color)
        for segment, part, color in zip(segments, parts, colors, strict=True)
    )
    try:
        return SegmentedMesh(tuple(colored), nested)
    except ValueError as error:
        raise document.error((key,), str(error)) from None


# --- refinement -------------------------------------------------------------------------------------------------------

TOLERANCE = 0.05
"""How far, in scene units, a straight edge may leave the curve that the map makes of it: half of the noise."""

SHORTEST = 1.0
"""Edges up to this long, in scene units, are not halved: they follow any bend down to a radius of 2.5.

In an elastic solid they may be as long as a cell of its lattice, within which all moves in straight lines."""

STATES = 8
"""Random states in which every edge is compared with its curve."""

MOST_FACES = 20_000
"""Faces of all segments that refinement may lead to; beyond it the tolerance doubles."""

PLACES = ((0.5, 0.5), (0.25, 0.75), (0.75, 0.25))
"""Shares of an edge's two ends at which it is compared, symmetric, so that neighbours split a shared edge alike."""


def refined(rest: SegmentedMesh, draw: Draw) -> SegmentedMesh:
    """Mesh with all edges halved that ``draw``'s maps bend away from a straight line; itself where none is.

    An edge is halved where in one of ``STATES`` random states the map of a place on it is farther than ``TOLERANCE``
    from the straight line between the maps of its ends. Affine maps, as those of joints, split nothing. Segments that
    share a map and an edge split it alike; where they touch without sharing edges they part or meet by at most twice
    the tolerance. ``rest`` is in scene units, and ``draw`` gives one map for each segment.
    """
    steps = draw.steps if isinstance(draw, RandomMotion) else ()
    cells = [sampler.solid.cell for sampler, _ in steps if isinstance(sampler, ElasticSampler)]
    shortest = max([SHORTEST, *cells])
    corners = [segment.vertices[segment.faces] for segment in rest.segments]
    if not any((norm(c - np.roll(c, 1, axis=1), axis=2) > shortest).any() for c in corners):
        return rest
    states = [draw(example_rng(0, index)) for index in range(STATES)]
    tolerance = TOLERANCE
    most = max(MOST_FACES, 2 * sum(len(segment.faces) for segment in rest.segments))
    while True:
        try:
            return _refined_surface(rest, states, (tolerance, shortest), most)
        except TooManyFaces:
            tolerance *= 2


def _refined_surface(rest: SegmentedMesh, states: list[Deformations], limits: Range, most: int) -> SegmentedMesh:
    segments = []
    for index, segment in enumerate(rest.segments):
        bent = partial(_bent, maps=[state[index] for state in states], limits=limits)
        vertices, faces = split_edges(segment.vertices, segment.faces, bent, most)
        most -= len(faces)
        same = len(faces) == len(segment.faces)
        segments.append(segment if same else replace(segment, vertices=vertices, faces=faces))
    return replace(rest, segments=tuple(segments))


def _bent(ends: Float[ndarray, "e 2 3"], maps: list[Deformation], limits: Range) -> Bool[ndarray, " e"]:
    """Which edges a map makes a curve of, farther from its chord than the first limit, if longer than the second."""
    result, (tolerance, shortest) = np.zeros(len(ends), bool), limits
    long = norm(ends[:, 0] - ends[:, 1], axis=1) > shortest
    for deform in maps:
        rows = np.flatnonzero(long & ~result)
        if len(rows) == 0:
            break
        a, b = ends[rows, 0], ends[rows, 1]
        moved = deform(np.concatenate([a, b, *(s * a + t * b for s, t in PLACES)])).reshape(2 + len(PLACES), -1, 3)
        for (s, t), place in zip(PLACES, moved[2:], strict=True):
            away = norm(place - (s * moved[0] + t * moved[1]), axis=1)
            result[rows] |= away > tolerance
    return result
