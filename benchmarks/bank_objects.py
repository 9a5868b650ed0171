"""Objects of our own, which no weights were trained on, and other things for a desk: all modelled by code.

    python benchmarks/bank_objects.py

prints a table of them. An object has its real size, in metres; things are in scene units, in which an object's shortest
side is about 20. Every shape is a solid with outward faces, and each run makes the same bits of it, so that the
statistical model that ``kept_model`` keeps in the user's cache is found again.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, OpType

from mereo.geometry.conventions import Way
from mereo.geometry.marching_cubes import zero_surface
from mereo.geometry.mesh_check import mesh_of
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import kept_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene

OWN: tuple[str, ...] = ("drill", "mug", "bracket", "bottle", "teddy", "gripper")

WAYS: dict[str, Way] = {"drill": "rigid", "mug": "rigid", "bracket": "rigid", "bottle": "stiff", "teddy": "soft"}
"""How objects move; the gripper does by the joints of ``GRIPPER``."""

GRIPPER = """name: gripper
units: m
segments:
  - {name: palm, file: palm.ply, color: [120, 120, 130]}
  - {name: left, file: left.ply, color: [230, 120, 40]}
  - {name: right, file: right.ply, color: [40, 130, 220]}
camera: {aperture: 360, axis: [0, 0, 1], distance: [105, 135], roll: true, field_of_view: 38}
deformations:
  - {type: joint, segments: [left], pivot: [-0.032, 0, 0.05], axis: [0, 1, 0], angle: [-28, 7]}
  - {type: joint, segments: [right], pivot: [0.032, 0, 0.05], axis: [0, 1, 0], angle: [-7, 28]}
"""
"""Scene file of the gripper: each finger turns about its hinge pin, apart by 28 degrees and together by 7."""

Points = Float[np.ndarray, "*n 3"]
Place = tuple[float, float, float]

# --- shapes -----------------------------------------------------------------------------------------------------------


def solid_mesh(solid: Manifold, edge: float) -> trimesh.Trimesh:
    """Surface of a solid whose edges are at most ``edge`` long."""
    vertices, faces = mesh_of(solid.simplify(edge / 300).refine_to_length(edge))
    return trimesh.Trimesh(vertices, faces, process=False)


def rod(start: Place, end: Place, radius: float, end_radius: float | None = None, sides: int = 32) -> Manifold:
    """Cylinder, or cone, from one place to another."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    turn = trimesh.geometry.align_vectors([0, 0, 1], along)
    turn[:3, 3] = start
    return Manifold.cylinder(length, radius, radius if end_radius is None else end_radius, sides).transform(turn[:3])


def box(low: Place, high: Place, rounding: float = 0.0) -> Manifold:
    """Box between two corners, with round edges where ``rounding``, their radius, is above 0."""
    if rounding == 0:
        return Manifold.cube(tuple(np.subtract(high, low))).translate(low)
    ball = Manifold.sphere(rounding, 12)
    places = product(*zip(np.add(low, rounding).tolist(), np.subtract(high, rounding).tolist(), strict=True))
    return Manifold.batch_hull([ball.translate(place) for place in places])


def plate(outline: Sequence[tuple[float, float]], low: float, high: float) -> Manifold:
    """Outline (x, z), counterclockwise, extruded along y from ``low`` to ``high``."""
    return CrossSection([list(outline)]).extrude(high - low).rotate((90, 0, 0)).translate((0, high, 0))


def turned(profile: Sequence[tuple[float, float]], sides: int = 48) -> Manifold:
    """Solid of revolution about z of a closed profile (radius, height), counterclockwise."""
    return CrossSection([list(profile)]).revolve(sides)


def ellipsoid(points: Points, center: Place, radii: Place) -> Float[np.ndarray, "*n"]:
    """Distance of points to an ellipsoid, nearly; below 0 inside."""
    offset = (points - center) / radii
    size = np.linalg.norm(offset, axis=-1)
    return size * (size - 1) / np.maximum(np.linalg.norm(offset / radii, axis=-1), 1e-9)


def capsule(points: Points, start: Place, end: Place, radius: float) -> Float[np.ndarray, "*n"]:
    """Distance of points to a rod with round ends; below 0 inside."""
    along = np.subtract(end, start)
    share = np.clip((points - start) @ along / (along @ along), 0, 1)[..., None]
    return np.linalg.norm(points - start - share * along, axis=-1) - radius


# --- objects, in metres -----------------------------------------------------------------------------------------------


def drill() -> trimesh.Trimesh:
    """Cordless drill, 19 cm: motor, gearbox, chuck toward +x, a handle at 80 degrees, a battery foot and a trigger."""
    motor = Manifold.batch_hull([rod((-0.085, 0, 0), (0.01, 0, 0), 0.024), rod((-0.078, 0, 0), (0.006, 0, 0), 0.029)])
    gears = rod((0, 0, 0), (0.036, 0, 0), 0.027, 0.022)
    collar = rod((0.034, 0, 0), (0.062, 0, 0), 0.0195)
    chuck = rod((0.06, 0, 0), (0.088, 0, 0), 0.0195, 0.009)
    bit = rod((0.08, 0, 0), (0.105, 0, 0), 0.003, sides=12)
    ends = [(-0.03, -0.02, 0.02), (-0.052, -0.125, 0.021)]  # which are 10 degrees off the upright
    rings = [Manifold.cylinder(0.01, r, r, 32).scale((1, 0.8, 1)).translate((x, 0, z)) for x, z, r in ends]
    handle = Manifold.batch_hull(rings)
    battery = box((-0.095, -0.037, -0.158), (0.012, 0.037, -0.12), 0.008)
    guard = plate([(-0.02, -0.065), (-0.01, -0.062), (0.0, -0.035), (-0.002, -0.02), (-0.02, -0.02)], -0.008, 0.008)
    switch = rod((-0.018, -0.02, -0.033), (-0.018, 0.02, -0.033), 0.006, sides=16)
    solid = Manifold.batch_boolean([motor, gears, collar, chuck, bit, handle, battery, guard, switch], OpType.Add)
    return solid_mesh(solid, 0.011)


def mug() -> trimesh.Trimesh:
    """Mug, 96 mm high, with walls of 4.5 mm and a handle toward +x."""
    wall = [(0, 0), (0.034, 0), (0.038, 0.005), (0.041, 0.03), (0.041, 0.092), (0.0388, 0.096), (0.0365, 0.092)]
    cup = turned([*wall, (0.0365, 0.03), (0.033, 0.009), (0.028, 0.0065), (0, 0.0065)])
    ring = turned([(0.027 + 0.0055 * c, 0.0075 * s) for c, s in _circle(12)], 40)
    handle = ring.rotate((90, 0, 0)).scale((0.95, 1, 1.1)).translate((0.043, 0, 0.05))
    hollow = rod((0, 0, 0.004), (0, 0, 0.2), 0.039, sides=48)
    return solid_mesh(cup + (handle - hollow), 0.009)


def bracket() -> trimesh.Trimesh:
    """Angle bracket of 6 mm sheet, 80 x 50 x 70 mm, with two unlike ribs, round holes and a slot."""
    flat, upright = box((0, -0.025, 0), (0.08, 0.025, 0.006)), box((0, -0.025, 0), (0.006, 0.025, 0.07))
    corner = (0.005, 0.005)
    ribs = plate([corner, (0.052, 0.005), (0.052, 0.009), (0.009, 0.048), (0.005, 0.048)], -0.025, -0.02)
    ribs += plate([corner, (0.036, 0.005), (0.036, 0.009), (0.009, 0.034), (0.005, 0.034)], 0.02, 0.025)
    holes = [rod((x, y, -0.01), (x, y, 0.02), 0.0045, sides=24) for x, y in ((0.066, -0.012), (0.066, 0.012))]
    holes.append(rod((-0.01, 0.008, 0.056), (0.02, 0.008, 0.056), 0.006, sides=24))
    slot = [rod((x, 0.002, -0.01), (x, 0.002, 0.02), 0.004, sides=24) for x in (0.026, 0.044)]
    solid = flat + upright + ribs - Manifold.batch_boolean([*holes, Manifold.batch_hull(slot)], OpType.Add)
    return solid_mesh(solid, 0.006)


def bottle() -> trimesh.Trimesh:
    """Shampoo bottle, 19 x 7 x 4 cm: a flattened body with a waist, round shoulders and a cap."""
    radii = [0, 0.027, 0.031, 0.034, 0.0345, 0.033, 0.0335, 0.035, 0.034, 0.03, 0.024, 0.017, 0.0125, 0.0125]
    heights = [0, 0, 0.0015, 0.007, 0.04, 0.07, 0.1, 0.125, 0.137, 0.146, 0.152, 0.155, 0.157, 0.159]
    profile = np.array([*zip(radii, heights, strict=True), (0.0165, 0.159), (0.0155, 0.186), (0.0125, 0.19), (0, 0.19)])
    counts = np.round(np.linalg.norm(np.diff(profile, axis=0), axis=1) / 0.0042).astype(int)
    pieces = [np.linspace(profile[i], profile[i + 1], max(n, 1), endpoint=False) for i, n in enumerate(counts)]
    mesh = trimesh.creation.revolve(np.vstack([*pieces, profile[-1:]]), sections=40)
    x, y, z = mesh.vertices.T
    flat = np.interp(z, [0.14, 0.157], [1.0, 0.0])  # the body is of superellipses, the cap is round
    power = 2 + 0.6 * flat
    angle = np.arctan2(y, x)
    reach = (np.abs(np.cos(angle)) ** power + np.abs(np.sin(angle)) ** power) ** (-1 / power)
    mesh.vertices = np.stack([x * reach, y * reach * (1 - 0.42 * flat), z], axis=1)
    return mesh


def teddy() -> trimesh.Trimesh:
    """Toy bear that sits, 25 cm high, looking toward -y: ellipsoids that run smoothly into each other."""
    step = 0.0084
    axes = [np.arange(low, high, step) for low, high in ((-0.13, 0.13), (-0.16, 0.08), (-0.02, 0.26))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    parts = [
        (ellipsoid(points, (0, 0, 0.075), (0.064, 0.054, 0.075)), 0.02),
        (ellipsoid(points, (0, -0.006, 0.181), (0.053, 0.047, 0.047)), 0.014),
        (ellipsoid(points, (0, -0.052, 0.17), (0.022, 0.021, 0.018)), 0.01),
    ]
    for side in (-1, 1):
        parts += [
            (ellipsoid(points, (side * 0.043, 0.002, 0.224), (0.022, 0.012, 0.022)), 0.008),
            (capsule(points, (side * 0.05, -0.006, 0.125), (side * 0.092, -0.046, 0.088), 0.0225), 0.014),
            (capsule(points, (side * 0.036, -0.02, 0.032), (side * 0.062, -0.098, 0.03), 0.0275), 0.014),
            (ellipsoid(points, (side * 0.064, -0.112, 0.038), (0.028, 0.02, 0.036)), 0.012),
        ]
    field = parts[0][0]
    for distance, blend in parts[1:]:
        overlap = np.maximum(blend - np.abs(field - distance), 0.0) / blend
        field = np.minimum(field, distance) - overlap**2 * blend / 4
    vertices, faces = zero_surface(-field)
    mesh = trimesh.Trimesh(step * vertices, faces)
    trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.52, iterations=12)
    return mesh


def gripper() -> dict[str, trimesh.Trimesh]:
    """Gripper of a robot, 15 cm: a palm on a flange, and two fingers, each of which turns about a hinge pin."""
    palm = box((-0.048, -0.022, 0), (0.048, 0.022, 0.06), 0.004) + rod((0, 0, -0.014), (0, 0, 0.004), 0.0315)
    sockets = [box((s * 0.03 - 0.021, -0.0095, 0.036), (s * 0.03 + 0.021, 0.0095, 0.1)) for s in (-1.0, 1.0)]
    palm -= Manifold.batch_boolean(sockets, OpType.Add)
    outline = [(0.03, 0.05), (0.044, 0.054), (0.055, 0.085), (0.03, 0.118), (0.027, 0.146), (0.014, 0.146)]
    outline += [(0.014, 0.108), (0.036, 0.082), (0.024, 0.054)]
    meshes = {}
    for name, side in (("left", -1.0), ("right", 1.0)):
        pivot = side * 0.032
        palm += rod((pivot, -0.018, 0.05), (pivot, 0.018, 0.05), 0.004, sides=20)
        finger = plate(outline, -0.008, 0.008) + rod((0.032, -0.008, 0.05), (0.032, 0.008, 0.05), 0.0115)
        finger -= rod((0.032, -0.02, 0.05), (0.032, 0.02, 0.05), 0.0048, sides=20)
        meshes[name] = solid_mesh(finger if side > 0 else finger.mirror((1, 0, 0)), 0.007)
    return {"palm": solid_mesh(palm, 0.009), **meshes}


SOLIDS: tuple[Callable[[], trimesh.Trimesh], ...] = (drill, mug, bracket, bottle, teddy)
"""What makes the objects of one segment, in the order of their names."""


@lru_cache(maxsize=len(OWN))
def own_scene(name: str) -> Scene:
    """Scene of an object of ``OWN``, named as it is."""
    with TemporaryDirectory() as folder:
        meshes = gripper() if name == "gripper" else {name: SOLIDS[OWN.index(name)]()}
        files = [Path(folder) / f"{part}.ply" for part in meshes]
        for file, mesh in zip(files, meshes.values(), strict=True):
            mesh.export(file)
        if name != "gripper":
            return replace(scene_of_meshes(files, "m", WAYS[name]), name=name)
        path = Path(folder) / "gripper.yaml"
        path.write_text(GRIPPER, encoding="utf-8")
        return replace(load_scene(str(path)), file=None)


# --- things, in scene units -------------------------------------------------------------------------------------------


def _circle(sides: int) -> list[tuple[float, float]]:
    """Cosine and sine of the angles of a regular polygon."""
    return [(float(np.cos(a)), float(np.sin(a))) for a in np.arange(sides) * 2 * np.pi / sides]


@lru_cache(maxsize=1)
def things() -> tuple[trimesh.Trimesh, ...]:
    """Other things for a desk, each centred: book, can, ball, cup, cone, ring, wedge, angle, bowl, two boxes."""
    outer = [(20 * c, 20 + 20 * s) for c, s in _circle(32) if c > 1e-9 and s < 0]
    inner = [(17.5 * c, 20 + 17.5 * s) for c, s in _circle(32) if c > 1e-9 and s < 0]
    shapes = (
        (box((0, 0, 0), (42, 58, 9)), 7.0),
        (rod((0, 0, 0), (0, 0, 34), 10.5), 6.0),
        (Manifold.sphere(13, 48), 26.0),
        (turned([(0, 0), (9, 0), (12, 28), (10.6, 28), (7.8, 1.6), (0, 1.6)], 32), 6.0),
        (rod((0, 0, 0), (0, 0, 36), 14, 1.5), 6.0),
        (turned([(15 + 5 * c, 5 * s) for c, s in _circle(16)], 36), 26.0),
        (plate([(0, 0), (44, 0), (0, 24)], 0, 22), 6.0),
        (plate([(0, 0), (40, 0), (40, 6), (6, 6), (6, 28), (0, 28)], 0, 48), 7.0),
        (turned([(0, 0), *outer, (20, 20), (17.5, 20), *inner[::-1], (0, 2.5)], 32), 8.0),
        (box((0, 0, 0), (36, 28, 14)) + box((5, 3, 13.9), (27, 25, 30)), 6.0),
    )
    meshes = tuple(solid_mesh(solid, edge) for solid, edge in shapes)
    for mesh in meshes:
        mesh.vertices -= mesh.bounds.mean(axis=0)
    return meshes


def main() -> None:
    """Print what there is."""
    print("| object | segments | faces | size, units | unit, mm | modes | states | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    for name in OWN:
        started = time.perf_counter()
        scene = own_scene(name)
        model = kept_model(scene)
        seconds = time.perf_counter() - started
        assert scene.unit_m is not None
        size = " x ".join(f"{side:.1f}" for side in np.ptp(scene.rest.bounds, axis=0))
        faces = sum(len(segment.faces) for segment in scene.rest.segments)
        cells = (name, len(scene.rest.names), faces, size, f"{scene.unit_m * 1000:.2f}", model.count)
        print(f"| {' | '.join(map(str, (*cells, len(model.library), f'{seconds:.1f}')))} |")
    for mesh in things():
        print(len(mesh.faces), mesh.extents.round(1), mesh.is_watertight)


if __name__ == "__main__":
    main()
