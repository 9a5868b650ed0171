"""Scenes of your own, as YAML files: from the text to a ``Scene`` (docs/own-object.md explains every key).

Document -validated-> SceneFile -read_segments-> SegmentedMesh in the file's unit -scaled-> Scene
"""

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from mereo.deformation.samplers import RandomMotion
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.mesh_check import examine
from mereo.geometry.normalizer import Normalizer
from mereo.io.yaml_document import Document, similar
from mereo.scenes.files.defaults import default_deformations
from mereo.scenes.files.deformation_blocks import AnyDeformation, Misfit, Target
from mereo.scenes.files.refinement import refined
from mereo.scenes.files.schema import CameraBlock, SceneFile
from mereo.scenes.files.segments import read_segments
from mereo.scenes.recorded_states import load_states
from mereo.scenes.scene import SCENES, Scene, Workspace

ELSEWHERE = {"source", "segments", "model", "parts", "labels", "names", "cells"}
"""Keys that decide the meshes, which identify themselves, or nothing."""


class MeshWarning(UserWarning):
    """Warning that a mesh is no solid and is used all the same."""


def load(path: Path) -> Scene:
    """Scene of a YAML file.

    A mesh with holes or self-intersections is used with a ``MeshWarning``: the winding number decides what is inside.

    Raises ``ValueError`` and ``FileNotFoundError`` with file, line, value, rule and cure.
    """
    document = Document(path)
    file = read(document)
    return build(document, file, with_warnings(document, read_segments(document, file)))


def read(document: Document) -> SceneFile:
    """Validated content of a scene file. Its name must not be a built-in scene's, which weights would confuse."""
    file = document.validated(SceneFile)
    if file.name in SCENES:
        raise document.error(("name",), f"`name` is {file.name!r}, which is a built-in scene: choose another name")
    return file


def files_of(path: Path) -> list[Path]:
    """The scene file, the meshes or volume that it names, and its recorded states, whether they exist or not."""
    file = read(Document(path))
    parts = [part.file for part in file.segments or ()]
    named = [name for name in (*parts, file.model, file.labels, file.states) if name is not None]
    return [path, *(path.parent / name for name in named)]


def with_warnings(document: Document, mesh: SegmentedMesh) -> SegmentedMesh:
    """Mesh with segments that are no solids marked so, and one warning for each of them."""
    cure = f"repair it with `mereo scene check {document.path} --repair`"
    segments = []
    for segment in mesh.segments:
        health = examine(segment)
        if health.hopeless:
            raise ValueError(f"{document.path}: segment {segment.name!r} {health.hopeless[0]}: {cure}")
        if health.dirty:
            text = f"{document.path}: segment {segment.name!r} {' and '.join(health.dirty)}; the winding number "
            warnings.warn(text + f"decides what is inside it, which is slower: {cure}", MeshWarning, stacklevel=3)
        segments.append(replace(segment, solid=not health.dirty))
    return replace(mesh, segments=tuple(segments))


def build(document: Document, file: SceneFile, mesh: SegmentedMesh) -> Scene:
    """Scene of a mesh in the file's unit: scaled to ``size`` and centred, with its deformations."""
    placement = placed(mesh, file.size)
    rest = mesh.with_vertices([placement.apply(segment.vertices) for segment in mesh.segments])
    workspace = _workspace(document, file.camera, rest.bounds)
    unit_m, definition = file.units / placement.scale, file.model_dump_json(exclude=ELSEWHERE)
    if file.states is not None:
        scene = _recorded(document, file, rest, placement, workspace)
        definition += _digest(document.path.parent / file.states)
    else:
        blocks = file.deformations
        if blocks is None:
            blocks = list(_default_deformations(_Keyed(_content(mesh), mesh)))
            definition += str([block.model_dump() for block in blocks])
        motions = _random_motion(document, placement, rest, blocks)
        key = f"{_content(rest)} {placement.matrix.tolist()} {[block.model_dump() for block in blocks]}"
        rest = _refined(_Keyed(key, (rest, motions)))
        scene = Scene(file.name, rest, replace(motions, rest=rest), workspace, file.source)
    return replace(scene, unit_m=unit_m, T_scene_source=placement.matrix, definition=definition)


# --- what takes most of the time of loading a scene, which one command does several times ----------------------------

Value = TypeVar("Value")


@dataclass(frozen=True)
class _Keyed(Generic[Value]):
    """A value that is equal to another one of the same key."""

    key: str
    value: Value = field(compare=False)


@lru_cache(maxsize=4)
def _default_deformations(mesh: _Keyed[SegmentedMesh]) -> tuple[AnyDeformation, ...]:
    return default_deformations(mesh.value)


@lru_cache(maxsize=4)
def _refined(scene: _Keyed[tuple[SegmentedMesh, RandomMotion]]) -> SegmentedMesh:
    return refined(*scene.value)


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
    assert file.states is not None
    path = document.path.parent / file.states
    if not path.exists():
        raise document.error(("states",), f"`states` is {file.states!r}, and {path} does not exist: check the path")
    x, y, z = -placement.scale * placement.center
    states = load_states(path, rest, scale=placement.scale, shift=(x, y, z), held_out=file.held_out)
    return states.scene(file.name, rest, workspace, file.source)


def _digest(path: Path) -> str:
    """Digest of recorded states, a file or a directory: other states are another scene."""
    digest = hashlib.sha256()
    for file in [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file()):
        with file.open("rb") as content:
            digest.update(file.name.encode() + hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()


def placed(mesh: SegmentedMesh, size: float) -> Normalizer:
    """Map from the file's frame to the scene's: the joint box centred, its shortest side ``size`` long."""
    low, high = mesh.bounds
    shortest = float((high - low).min())
    if not shortest > 0:
        raise ValueError(f"the object's box has sides {(high - low).tolist()}; all must be above 0: check the meshes")
    return Normalizer((low + high) / 2, size / shortest)


def _workspace(document: Document, camera: CameraBlock, bounds: Float[np.ndarray, "2 3"]) -> Workspace:
    radius = float(np.linalg.norm(bounds[1] - bounds[0])) / 2
    if not camera.distance[0] > radius:
        raise document.error(
            ("camera", "distance"),
            f"`distance` starts at {camera.distance[0]:g}; the camera must stay outside the object, which reaches "
            f"{radius:.3g} scene units from its centre: start farther away, or lower `size`",
        )
    return camera.workspace()


def _random_motion(
    document: Document, placement: Normalizer, rest: SegmentedMesh, blocks: Sequence[AnyDeformation]
) -> RandomMotion:
    """All deformations of the file in their order; ``default_deformations`` where it has none."""
    steps = []
    for index, block in enumerate(blocks):
        members = _members(document, rest, index, block)
        moved = SegmentedMesh(tuple(rest.segments[i] for i in members))
        try:
            steps.append((block.sampler(Target(moved, rest.bounds, placement)), members))
        except Misfit as misfit:
            raise document.error(("deformations", index, misfit.key), str(misfit)) from None
    return RandomMotion(rest, tuple(steps))


def _members(document: Document, rest: SegmentedMesh, index: int, block: AnyDeformation) -> tuple[int, ...]:
    """Indices of the segments that a block moves."""
    names = list(rest.names)
    for name in block.segments or ():
        if name not in names:
            place = ("deformations", index, "segments")
            raise document.error(place, f"no segment is called {name!r}: {similar(name, names)}")
    return tuple(i for i, name in enumerate(names) if block.segments is None or name in block.segments)
