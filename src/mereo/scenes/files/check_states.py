"""What ``mereo scene check`` says of random states: how far they move, how they are seen, and what runs into what."""

from dataclasses import replace

import numpy as np

from mereo.deformation.samplers import JointSampler, RandomMotion
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.overlap import Overlap, overlaps
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.scenes.motion import motion
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.seeds import example_rng

STATES = 12
"""Random states in which segments are tested for overlap, and for being in view."""

STATE_TOLERANCE = 0.02
"""Share of a segment that another one may overlap in a random state."""

WIDTH = 96
"""Of the depth image in pixels, the default of ``synthesis.config.GenerateConfig``."""

NARROWED = (0.75, 0.5, 0.25, 0.1)
"""Shares of a joint's ranges that are tried where it turns segments into each other."""


def report_states(scene: Scene) -> int:
    """Print how far random states move, how they are seen, and each overlap with its cause; returns their number."""
    moved = motion(scene.rest, scene.sample_deformations)
    print(f"motion: {moved.mean:.1%} of the longest side in a typical state, {moved.largest:.1%} where it moves most")
    print(f"up: {_direction(scene.workspace)}")
    worst: dict[frozenset[str], Overlap] = {}
    seen = 1.0
    pixels: list[int] = []
    for index in range(STATES):
        rng = example_rng(0, index)
        mesh = scene.sample_state(rng).mesh
        for found in overlaps(mesh, STATE_TOLERANCE):
            pair = frozenset((found.small, found.large))
            worst[pair] = max(worst.get(pair, found), found, key=lambda overlap: overlap.share)
        share, count = _view(scene.workspace, mesh, rng)
        seen = min(seen, share)
        pixels.append(count)
    middle = np.median(pixels)
    print(f"picture: a typical view shows it in {middle:.0f} of {WIDTH**2:,} pixels ({middle / WIDTH**2:.1%})")
    for overlap in worst.values():
        print(f"  fault: in random states {overlap}: {_cure(scene, overlap)}")
    if seen < 0.98:
        print(f"  note: in a random view only {seen:.0%} of the object is in the picture: widen `field_of_view`")
    return len(worst)


def _direction(workspace: Workspace) -> str:
    """Which way the camera takes for up."""
    if workspace.all_around:
        return "no side: the camera looks from all around"
    axis = np.array(workspace.axis, dtype=float)
    index = int(np.abs(axis).argmax())
    if np.count_nonzero(axis) == 1:
        name = f"{'' if axis[index] > 0 else '-'}{'xyz'[index]}"
        return f"{name}, the camera's `axis`; where another side of the files is up, correct it"
    return f"[{', '.join(f'{value:.3g}' for value in axis)}], the camera's `axis`"


def _view(workspace: Workspace, mesh: SegmentedMesh, rng: np.random.Generator) -> tuple[float, int]:
    """Share of the vertices in a random picture, and the number of pixels that show the object."""
    local = mesh.transformed(inverse_rigid(workspace.sample(rng, mesh.bounds.mean(axis=0))))
    camera = Camera.from_fov(WIDTH, WIDTH, workspace.fov_rad)
    places = camera.project(local.merged()[0])
    hits = Solids(local).first_hit(camera.directions().reshape(-1, 3))
    within = ((places > 0) & (places < WIDTH)).all(axis=1)
    return float(within.mean()), int(np.isfinite(hits.distance).sum())


# --- causes of overlaps -----------------------------------------------------------------------------------------------


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
    for share in NARROWED:
        if _free(scene, _narrowed(draw, apart, share), overlap):
            return f"{moves}: {share:.0%} of the range keeps them apart; or correct the pivot and the axis"
    return f"{moves}, and they meet at a tenth of the range already: correct its pivot and axis, or move both"


def _narrowed(draw: RandomMotion, which: list[int], share: float) -> RandomMotion:
    """The same motion with some of its joints narrowed."""
    steps = list(draw.steps)
    for index in which:
        joint, members = steps[index]
        assert isinstance(joint, JointSampler)
        steps[index] = (joint.narrowed(share), members)
    return replace(draw, steps=tuple(steps))


def _free(scene: Scene, draw: RandomMotion, overlap: Overlap) -> bool:
    """Whether the two segments of an overlap keep apart in all of the states."""
    names = (overlap.small, overlap.large)
    parts = [scene.rest.names.index(name) for name in sorted(names, key=scene.rest.names.index)]
    nested = tuple(pair for pair in scene.rest.nested if set(pair) == set(names))
    for index in range(STATES):
        mesh = scene.deform(draw(example_rng(0, index))).mesh
        if overlaps(SegmentedMesh(tuple(mesh.segments[part] for part in parts), nested), STATE_TOLERANCE):
            return False
    return True
