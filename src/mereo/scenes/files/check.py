"""``mereo scene check``: what a user should know of a scene's meshes before spending hours of training, and repairs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from mereo.geometry.conventions import UNITS_M
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import PLAUSIBLE_M, Health, examine, likely_unit
from mereo.geometry.mesh_repair import repaired, without_overlaps
from mereo.geometry.overlap import grid_volume, overlaps
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.scratch_folders import remove_abandoned
from mereo.io.yaml_document import Document
from mereo.scenes.files.build import build, read
from mereo.scenes.files.check_states import report_states
from mereo.scenes.files.rewrite import with_segment_files
from mereo.scenes.files.segments import read_segments
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.scene import SCENES


def check_scene(name: str, repair: bool = False) -> None:
    """Print what each segment, the overlaps, the unit and random states are like; repair meshes where asked to.

    Args:
        name: a built-in name or a scene file.
        repair: write repaired copies of faulty meshes beside a YAML file, as ``SEGMENT-repaired.ply``, and a scene file
            ``NAME-repaired.yaml`` that names them. No existing file is changed.

    Raises ``ValueError`` that counts the faults left, ``FileExistsError`` where a repaired file is there already.
    """
    if not is_yaml(name):
        if repair:
            raise ValueError(f"--repair works on YAML scene files, and {name!r} is none: repair its meshes where it is")
        scene = load_scene(name)
        faults = _report(scene.rest, _examined(scene.rest), "cubic units")
    else:
        document = Document(Path(name))
        file = read(document)
        mesh = read_segments(document, file)
        health = _examined(mesh)
        unit = next((key for key, value in UNITS_M.items() if value == file.units), "unit")
        faults = _report(mesh, health, f"{unit}³")
        _report_size(mesh, file.units, unit)
        if faults and repair:
            _check_repaired(document, mesh, health)
            return
        if repair:
            print("no mesh needs a repair")
        if any(found.hopeless for found in health):
            raise _refusal(name, faults)
        scene = build(document, file, _marked(mesh, health))
        _report_refinement(mesh, scene.rest)
    collisions = report_states(scene) if name not in SCENES else 0
    if faults + collisions:
        raise _refusal(name, faults, collisions)
    nested = "".join(f", {inner} nested in {outer}" for inner, outer in scene.rest.nested)
    print(f"{scene.name}: {len(scene.rest.segments)} segments, closed, outward oriented, without overlap{nested}")
    print(f"source: {scene.source}")


def _refusal(name: str, faults: int, collisions: int = 0) -> ValueError:
    """Error about faults of meshes and collisions in random states, which no repair of a mesh mends."""
    count = faults + collisions
    cures = ["repair the meshes with --repair" if is_yaml(name) else "correct its meshes"] if faults else []
    cures += ["correct its deformations"] if collisions else []
    return ValueError(f"{name} has {count} {'fault' if count == 1 else 'faults'}, listed above: {', and '.join(cures)}")


def _report_refinement(mesh: SegmentedMesh, rest: SegmentedMesh) -> None:
    """Print how many faces a scene has more than its files."""
    before, now = (sum(len(segment.faces) for segment in each.segments) for each in (mesh, rest))
    if now > before:
        print(f"faces: {before:,} in the files, {now:,} after dividing long ones, so that they bend")


def _examined(mesh: SegmentedMesh) -> list[Health]:
    return [examine(segment) for segment in mesh.segments]


def _report(mesh: SegmentedMesh, health: list[Health], unit: str) -> int:
    """Print each segment and each overlap; returns the number of faults."""
    faults = 0
    usable = not any(found.hopeless for found in health)
    volumes = mesh.owned_volumes if usable else [np.nan] * len(health)
    for segment, found, volume in zip(mesh.segments, health, volumes, strict=True):
        inside = volume if found.sound or found.hopeless else grid_volume(replace(segment, solid=False))
        amount = f"   volume {inside:.4g} {unit}" if np.isfinite(inside) else ""
        print(f"{segment.name:<20} {len(segment.faces):>7} faces{amount}")
        for fault in (*found.hopeless, *found.dirty):
            faults += 1
            print(f"  fault: it {fault}")
    if usable:
        for overlap in overlaps(_marked(mesh, health)):
            faults += 1
            print(f"  fault: {overlap}")
    return faults


def _marked(mesh: SegmentedMesh, health: list[Health]) -> SegmentedMesh:
    """Mesh with segments that are no solids marked so."""
    marked = (replace(s, solid=found.sound) for s, found in zip(mesh.segments, health, strict=True))
    return replace(mesh, segments=tuple(marked))


def _report_size(mesh: SegmentedMesh, unit_m: float, unit: str) -> None:
    sides = mesh.bounds[1] - mesh.bounds[0]
    longest_m = float(sides.max()) * unit_m
    print(f"size: {' x '.join(f'{side:.4g}' for side in sides)} {unit}; the longest side is {longest_m:.3g} m")
    if not PLAUSIBLE_M[0] <= longest_m <= PLAUSIBLE_M[1]:
        print(f"  note: that is unlikely for a depth camera's object; the unit may be {likely_unit(mesh.bounds)}")


# --- repairs ----------------------------------------------------------------------------------------------------------


def _check_repaired(document: Document, mesh: SegmentedMesh, health: list[Health]) -> None:
    """Repair, say what was changed, write it, and check what was written."""
    fixed = [repaired(segment) for segment in mesh.segments]
    changes = {fix.segment.name: list(fix.changes) for fix in fixed}
    whole, cuts = without_overlaps(replace(mesh, segments=tuple(fix.segment for fix in fixed)))
    for name, cut in cuts.items():
        changes[name] += cut
    changed = [segment for segment in whole.segments if changes[segment.name]]
    for segment in changed:
        index = mesh.names.index(segment.name)
        difference = _difference(mesh.segments[index], health[index], segment)
        print(f"repaired {segment.name}: {'; '.join(changes[segment.name])} ({difference})")
    path = _write(document, whole, {segment.name for segment in changed})
    print(f"wrote {path} and the meshes that it names; checked again:")
    check_scene(str(path))


def _difference(before: Segment, health: Health, after: Segment) -> str:
    faces = f"{len(before.faces)} faces before, {len(after.faces)} now"
    if health.hopeless:
        return faces
    was = before.volume if health.sound else grid_volume(replace(before, solid=False))
    return f"{faces}; volume {100 * (after.volume / was - 1) if was else np.inf:+.2g} %"


def _write(document: Document, mesh: SegmentedMesh, changed: set[str]) -> Path:
    """The repaired meshes and a scene file that names them, beside the original."""
    path = document.path.with_name(f"{document.path.stem}-repaired{document.path.suffix}")
    text, files = with_segment_files(document, mesh, changed)
    meshes = {document.path.parent / file: _ply(mesh, name) for name, file in files.items()}
    # a mesh of the same bytes is one that this wrote before it was killed
    missing = {place: content for place, content in meshes.items() if not _holds(place, content)}
    for place in (path, *missing):
        check_file_place(place)
        if place.exists():
            raise FileExistsError(f"{place} exists; it is not overwritten: move or remove it")
    for place, content in missing.items():
        with atomic_file(place, force=False) as temporary:
            temporary.write_bytes(content)
    with atomic_file(path, force=False) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _ply(mesh: SegmentedMesh, name: str) -> bytes:
    segment = mesh.segments[mesh.names.index(name)]
    content = trimesh.Trimesh(segment.vertices, segment.faces, process=False).export(file_type="ply")
    assert isinstance(content, bytes)
    return content


def _holds(place: Path, content: bytes) -> bool:
    remove_abandoned(place)
    return place.is_file() and not place.is_symlink() and place.read_bytes() == content
