"""``mereo scene check``: what a user should know of a scene's meshes before spending hours of training, and repairs."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
import yaml
from numpy.random import Generator

from mereo.deformation.samplers import JointSampler, RandomMotion
from mereo.geometry.brief import counted
from mereo.geometry.camera import Camera
from mereo.geometry.conventions import UNITS_M, Texts
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import (
    CROSSED,
    PLAUSIBLE_M,
    Health,
    Overlap,
    examine,
    grid_volume,
    likely_unit,
    near,
    overlaps,
)
from mereo.geometry.mesh_repair import farthest, repaired, without_overlaps
from mereo.geometry.solids import Solids
from mereo.geometry.symmetry import TOLERANCE, describe_symmetries, find_symmetries
from mereo.geometry.transforms import inverse_rigid, longest_side
from mereo.io.atomic_files import JsonObject, check_file_place, remove_abandoned, write_file
from mereo.io.yaml_document import Document
from mereo.scenes.files.build import build, link_frames, read, read_segments
from mereo.scenes.files.deformation_blocks import is_robot_joint
from mereo.scenes.files.template import flat_base, measure_motion
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.scene import SCENES, Scene, Workspace
from mereo.scenes.seeds import example_rng


def check_scene(name: str, repair: bool = False) -> None:
    """Print what each segment, the overlaps, the unit and random states of a built-in scene or a file are like.

    With ``repair`` repaired copies of faulty meshes are written next to a YAML file, as ``SEGMENT-repaired.ply``, and a
    scene file ``NAME-repaired.yaml`` that names them. No existing file is changed.

    Raises ``ValueError`` that counts the faults left, ``FileExistsError`` where a repaired file is there already.
    """
    if not is_yaml(name):
        if repair:
            raise ValueError(f"--repair works on YAML scene files, and {name!r} is none: repair its meshes where it is")
        scene = load_scene(name)
        faults = _report(scene.rest, [examine(segment) for segment in scene.rest.segments], "cubic units")
    else:
        document = Document(Path(name))
        file = read(document)
        mesh = read_segments(document, file)
        unit = next((key for key, value in UNITS_M.items() if value == file.units), "unit")
        health = [examine(segment, unit) for segment in mesh.segments]
        faults = _report(mesh, health, f"{unit}³", is_mechanism := any(map(is_robot_joint, file.deformations or ())))
        sides = np.ptp(mesh.bounds, axis=0)
        longest_m = float(sides.max()) * file.units
        print(f"size: {' x '.join(f'{side:.4g}' for side in sides)} {unit}; the longest side is {longest_m:.3g} m")
        if not PLAUSIBLE_M[0] <= longest_m <= PLAUSIBLE_M[1]:
            guess = likely_unit(mesh.bounds)
            print(f"  note: that is unlikely for a depth camera's object; the unit may be {guess}")
        if repair and not (faults == 0 and all(condition.sound for condition in health)):
            _check_repaired(document, mesh, health, unit, is_mechanism)
            return
        if repair:
            print("no mesh needs a repair")
        if any(condition.hopeless for condition in health):
            raise _refusal(name, faults)
        scene = build(document, file, _marked(mesh, health))
        before, now = (sum(len(segment.faces) for segment in each.segments) for each in (mesh, scene.rest))
        if now > before:
            print(f"faces: {before:,} in the files, {now:,} after dividing long ones, so that they bend")
    collisions = _report_states(scene) if name not in SCENES else 0
    if faults + collisions:
        raise _refusal(name, faults, collisions)
    nested = "".join(f", {inner} nested in {outer}" for inner, outer in scene.rest.nested)
    apart = "" if _is_mechanism(scene) else ", without overlap"
    print(f"{scene.name}: {len(scene.rest.segments)} segments, closed, outward oriented{apart}{nested}")
    print(f"source: {scene.source}")


def _refusal(name: str, faults: int, collisions: int = 0) -> ValueError:
    """Error about faults of meshes and collisions in random states, which no repair of a mesh mends."""
    cures = ["repair the meshes with --repair" if is_yaml(name) else "correct its meshes"] if faults else []
    cures += ["correct its deformations"] if collisions else []
    return ValueError(f"{name} has {counted(faults + collisions, 'fault')}, listed above: {', and '.join(cures)}")


def _is_mechanism(scene: Scene) -> bool:
    """Whether a scene has joints with names, as robots do: their links may overlap."""
    return isinstance(scene.sample_deformations, RandomMotion) and bool(scene.sample_deformations.joints)


def _report(mesh: SegmentedMesh, health: list[Health], unit: str, is_mechanism: bool = False) -> int:
    """Print each segment and each overlap; returns the number of faults.

    Overlaps are none of a mechanism, whose links are often made of shells that overlap, too, such as a motor's.
    """
    faults = 0
    usable = not any(condition.hopeless for condition in health)
    volumes = mesh.owned_volumes if usable else [np.nan] * len(health)
    for segment, condition, volume in zip(mesh.segments, health, volumes, strict=True):
        inside = volume if condition.sound or condition.hopeless else grid_volume(replace(segment, solid=False))
        amount = f"   volume {inside:.4g} {unit}" if np.isfinite(inside) else ""
        print(f"{segment.name:<20} {len(segment.faces):>7} faces{amount}")
        harmless = [what for what in condition.dirty if is_mechanism and what.startswith(CROSSED)]
        bad = [what for what in (*condition.hopeless, *condition.dirty) if what not in harmless]
        faults += len(bad)
        for kind, each in (("fault", bad), ("note", [*harmless, *condition.notes])):
            for what in each:
                print(f"  {kind}: it {what}")
        if not condition.mendable:
            print(f"  cure: no repair makes a solid of it; export {segment.name} again as a closed surface")
    if usable:
        shared = overlaps(_marked(mesh, health))
        count = len(health)
        faults += 0 if is_mechanism else len(shared)
        for overlap in shared:
            print(f"  {'note' if is_mechanism else 'fault'}: {overlap}")
        if count > 2 and not is_mechanism and len(shared) > count * (count - 1) / 4:
            print("  note: most pairs overlap; the files may each have a frame of their own: export them assembled")
    return faults


def _marked(mesh: SegmentedMesh, health: list[Health]) -> SegmentedMesh:
    """Mesh with segments that are no solids marked so."""
    marked = (replace(s, solid=condition.sound) for s, condition in zip(mesh.segments, health, strict=True))
    return replace(mesh, segments=tuple(marked))


# --- repairs ----------------------------------------------------------------------------------------------------------

NOTABLE = 1e-3
"""Distance of two surfaces, in longest sides, from which on the place is printed."""


def _check_repaired(
    document: Document, mesh: SegmentedMesh, health: list[Health], unit: str, is_mechanism: bool
) -> None:
    """Repair, say what was changed, write it, and check what was written."""
    fixed = [repaired(segment, unit) for segment in mesh.segments]
    whole = replace(mesh, segments=tuple(fix.segment for fix in fixed))
    cuts = dict[str, list[str]]()
    if not is_mechanism:
        whole, cuts = without_overlaps(whole)
    changed = set[str]()
    for before, condition, fix, after in zip(mesh.segments, health, fixed, whole.segments, strict=True):
        if changes := [*fix.changes, *cuts.get(after.name, ())]:
            changed.add(after.name)
            print(f"repaired {after.name}: {'; '.join(changes)} ({_difference(before, condition, after)})")
            print(f"  {_moved(before, fix.kept, after, unit)}")
    path = _write(document, whole, changed)
    print(f"wrote {path} and the meshes that it names; checked again:")
    check_scene(str(path))


def _difference(before: Segment, health: Health, after: Segment) -> str:
    faces = f"{len(before.faces)} faces before, {len(after.faces)} now"
    if health.hopeless:
        return faces
    was = before.volume if health.sound else grid_volume(replace(before, solid=False))
    return f"{faces}; volume {100 * (after.volume / was - 1) if was else np.inf:+.2g} %"


def _moved(before: Segment, kept: Segment, after: Segment, unit: str) -> str:
    """How the longest side changed, and how far the two surfaces are apart, each from the other where that is more."""
    finite = before.vertices[np.isfinite(before.vertices).all(axis=1)]
    was, now = (longest_side(vertices) for vertices in (finite, after.vertices))
    (lost, where), (filled, within) = farthest(kept, after)
    new, place = max(farthest(after, kept), key=lambda reach: reach[0])
    text = f"longest side {was:.5g} {unit} before, {now:.5g} now; the old surface reaches at most "
    text += f"{lost if lost > 1e-9 * was else 0:.2g} {unit} out of the new one"
    text += f" ({near(where, unit)})" if lost > NOTABLE * was else ""
    if filled > NOTABLE * was:
        text += f", and {filled:.2g} {unit} into it ({near(within, unit)}), where gaps were closed"
    if new > max(lost, filled, NOTABLE * was):
        text += f"; the new one is at most {new:.2g} {unit} from the old ({near(place, unit)})"
    return text


def _write(document: Document, mesh: SegmentedMesh, changed: set[str]) -> Path:
    """The repaired meshes and a scene file that names them, next to the original."""
    path = document.path.with_name(f"{document.path.stem}-repaired{document.path.suffix}")
    text, files = _with_segment_files(document, mesh, changed)
    meshes = dict[Path, bytes]()
    for name, file in files.items():
        segment = mesh.segments[mesh.names.index(name)]
        content = trimesh.Trimesh(segment.vertices, segment.faces, process=False).export(file_type="ply")
        assert isinstance(content, bytes)
        meshes[document.path.parent / file] = content
    # a mesh of the same bytes is one that this wrote before it was killed
    missing = {place: content for place, content in meshes.items() if not _holds(place, content)}
    for place in (path, *missing):
        check_file_place(place)
        if place.exists():
            raise FileExistsError(f"{place} exists; it is not overwritten: move or remove it")
    for place, content in missing.items():
        write_file(place, content, force=False)
    write_file(path, text, force=False)
    return path


def _holds(place: Path, content: bytes) -> bool:
    remove_abandoned(place.parent, place.name)
    return place.is_file() and not place.is_symlink() and place.read_bytes() == content


KINDS = ("segments", "model", "parts", "robot_meshes", "labels", "names", "cells")
"""Keys that say where the segments come from."""

HEADER = """\
# {name} with repaired meshes, written by `mereo scene check {name} --repair`.
# Everything else says the same as there; the comments are there too.
"""


def _with_segment_files(document: Document, mesh: SegmentedMesh, changed: set[str]) -> tuple[str, Texts]:
    """Text of a scene file that says what ``document`` says with new files for changed segments, and their names.

    Where the segments were parts of a model or labels of a volume, all get a file of their own: one scene file takes
    its segments from one kind of source.
    """
    kept = "segments" in document.data
    outer = dict(mesh.nested)
    frames = link_frames(document, read(document))
    files = {name: re.sub(r"[^\w.-]+", "_", name) + "-repaired.ply" for name in (changed if kept else mesh.names)}
    if kept:
        segments = [{**block, "file": files.get(block["name"], block["file"])} for block in document.data["segments"]]
    else:
        segments = [
            {"name": segment.name, "file": files[segment.name], "color": list(segment.color)}
            | ({"nested_in": outer[segment.name]} if segment.name in outer else {})
            | ({"frame": frames[segment.name].tolist()} if segment.name in frames else {})
            for segment in mesh.segments
        ]
    first = next(key for key in document.data if key in KINDS)
    data: JsonObject = {}
    for key, value in document.data.items():
        if key == first:
            data["segments"] = segments
        elif key not in KINDS:
            data[key] = value
    body = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    return HEADER.format(name=document.path.name) + body, files


# --- states -----------------------------------------------------------------------------------------------------------

STATES = 12
"""Random states in which segments are tested for overlap, and for being in view."""

STATE_TOLERANCE = 0.02
"""Share of a segment that another one may overlap in a random state."""

WIDTH = 96
"""Of the depth image in pixels, the default of ``synthesis.config.GenerateConfig``."""


def _report_states(scene: Scene) -> int:
    """Print how far random states move, how they are seen, and each overlap with its cause; returns their number."""
    moved = measure_motion(scene.rest, scene.sample_deformations)
    print(f"motion: {moved.mean:.1%} of the longest side in a typical state, {moved.largest:.1%} where it moves most")
    print(f"up: {_direction(scene.workspace)}")
    if base := flat_base(scene.rest, scene.workspace.axis):
        print(f"base: {base.describe(scene.workspace)}")
    for sentence in describe_symmetries(find_symmetries(scene.rest, TOLERANCE), scene.rest.names):
        print(f"symmetry: {sentence}")
    at_rest = {frozenset((each.small, each.large)) for each in overlaps(scene.rest)}  # faults by themselves
    worst = dict[frozenset[str], Overlap]()
    views = list[tuple[float, int]]()
    for index in range(STATES):
        rng = example_rng(0, index)
        mesh = scene.sample_state(rng).mesh
        for overlap in overlaps(mesh, STATE_TOLERANCE):
            pair = frozenset((overlap.small, overlap.large))
            if pair not in at_rest:
                worst[pair] = max(worst.get(pair, overlap), overlap, key=lambda each: each.share)
        views.append(_view(scene.workspace, mesh, rng))
    seen = min(share for share, _ in views)
    middle = np.median([count for _, count in views])
    print(f"picture: a typical view shows it in {middle:.0f} of {WIDTH**2:,} pixels ({middle / WIDTH**2:.1%})")
    is_mechanism = _is_mechanism(scene)
    for overlap in worst.values():
        text = f"in random states {overlap}"
        print(f"  note: {text}" if is_mechanism else f"  fault: {text}: {_cure(scene, overlap)}")
    if seen < 0.98:
        print(f"  note: in a random view only {seen:.0%} of the object is in the picture: widen `field_of_view`")
    return 0 if is_mechanism else len(worst)


def _direction(workspace: Workspace) -> str:
    """Which way the camera takes for up."""
    if workspace.all_around:
        return "no side: the camera looks from all around"
    axis = np.array(workspace.axis, float)
    index = int(np.abs(axis).argmax())
    if np.count_nonzero(axis) == 1:
        name = f"{'' if axis[index] > 0 else '-'}{'xyz'[index]}"
        return f"{name}, the camera's `axis`; where another side of the files is up, correct it"
    return f"[{', '.join(f'{value:.3g}' for value in axis)}], the camera's `axis`"


def _view(workspace: Workspace, mesh: SegmentedMesh, rng: Generator) -> tuple[float, int]:
    """Share of the vertices in a random picture, and the number of pixels that show the object."""
    local = mesh.transformed(inverse_rigid(workspace.sample(rng, mesh.bounds.mean(axis=0))))
    camera = Camera.from_fov(WIDTH, WIDTH, workspace.fov_rad)
    places = camera.project(local.merged()[0])
    hits = Solids(local).first_hit(camera.directions().reshape(-1, 3))
    within = ((places > 0) & (places < WIDTH)).all(axis=1)
    return float(within.mean()), int(np.isfinite(hits.distance).sum())


def _cure(scene: Scene, overlap: Overlap) -> str:
    """Why two segments run into each other in some states, and what helps."""
    draw = scene.sample_deformations
    if not isinstance(draw, RandomMotion):
        return "narrow the deformations, or let both move by the same ones"
    pair = {scene.rest.names.index(overlap.small), scene.rest.names.index(overlap.large)}
    apart = [index for index, (_, members) in enumerate(draw.steps) if len(pair & set(members)) == 1]
    if not apart:
        return "both move by the same maps, but their faces are too large to follow them: deform less, or mesh finer"
    titles = [f"{draw.title(index + 1, *draw.steps[index])!r}" for index in apart]
    moves = f"{' and '.join(titles)} {'moves' if len(apart) == 1 else 'move'} one of the two alone"
    if not all(isinstance(draw.steps[index][0], JointSampler) for index in apart):
        return f"{moves}: leave out its `segments`, so that both move by it, or deform less"
    return f"{moves}: narrow its range, correct its pivot and axis, or move both"
