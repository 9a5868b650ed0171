"""Frames of the bank of hypotheses: objects, whole and in part, by several cameras, on desks, and what is no object.

    (object, condition, number) -bank_view-> BankView: what a fit is given, and the truth about it

Everything is in scene units, of which one has the length that the object's scene states, or 5 mm.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from bank_objects import OWN, own_scene, things
from jaxtyping import Bool, Float, Int
from occluded_views import Occluding, occlude, surroundings
from scipy import ndimage
from scipy.spatial.transform import Rotation
from search import CUTS as EVERY_CUT
from search import OBJECTS as SHIPPED

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Hits, Solids
from mereo.geometry.transforms import inverse_rigid, look_at, rigid
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.clutter import OBJECT, Backdrop
from mereo.synthesis.config import SENSORS, GenerateConfig, SensorConfig
from mereo.synthesis.depth_sensor import observe
from mereo.synthesis.examples import View, sample_view

OBJECTS = (*SHIPPED, *OWN)

CUTS = {name: EVERY_CUT[name] for name in ("tool30", "screen50", "picture50")}

CAMERAS = ("structured-light", "time-of-flight", "stereo")

OTHERS = ("thing", "other object", "mirrored", "scaled", "half", "two", "merged", "patch")
"""What is not the object whole and alone: one of each for an object."""

DESKS = ("desk", "desk-thing", "desk-whole", "desk-empty")
"""Desks with the object, with its mask; with the mask of another thing; whole, without any mask; without the object."""

CONDITIONS = ("whole", *CAMERAS, "mask2", *CUTS, "unknown-unit", "surface", *DESKS, "other")

SEED = 2000
"""Training seed of the bank."""

CHIRAL = ("bunny", "engine", "liver", "tumor", "robot", "bracket")
"""Objects that differ from their mirror images."""

WIDE, STEREO_WIDE = 192, 640
"""Pixels along each side of a stereo camera's image, and of one of a desk; of a desk by a stereo camera, whose edges
are off by pixels of its own, whatever the object's size."""


@dataclass(frozen=True, eq=False)
class BankView:
    """Frame of the bank.

    Attributes:
        name, condition, number: the object that is looked for, and the kind of frame.
        seen: what a fit is given; its unit is a metre where the scene unit's length is known.
        view: state and camera; None where the frame does not show the object, whole and once.
        kind: of frames of other things, what it shows.
    """

    name: str
    condition: str
    number: int
    seen: Observation
    view: View | None
    kind: str

    @property
    def scene_unit(self) -> float | None:
        """Length of a scene unit in the frame's, as ``answer_frame`` takes it."""
        return None if self.condition == "unknown-unit" else 1.0


@cache
def scene_of(name: str) -> Scene:
    """Scene of a shipped object, or of one of the bank's own, on training seeds."""
    return (own_scene(name) if name in OWN else load_scene(name)).for_seed(SEED)


def unit_m(scene: Scene) -> float:
    """Metres in a scene unit, for the formulas of cameras."""
    return SensorConfig.metres_per_unit if scene.unit_m is None else scene.unit_m


def bank_view(name: str, condition: str, number: int) -> BankView:
    """Make a frame; the same arguments make the same one."""
    rng = np.random.default_rng([SEED, *map(ord, f"{name} {condition}"), number])
    scene = scene_of(name)
    kind = OTHERS[number % len(OTHERS)] if condition == "other" else ""
    if condition == "other":
        seen = other_view(scene, kind, rng)
        view = None
    elif condition in DESKS:
        seen, view = desk_view(scene, condition, number, rng)
    else:
        view = sample_view(scene, GenerateConfig(image_size=WIDE if condition == "stereo" else 96), rng)
        seen = own_view(scene, view, condition, rng)
    return BankView(name, condition, number, seen, view, kind)


# --- views of the object ----------------------------------------------------------------------------------------------


def sensor_of(scene: Scene, camera: str) -> SensorConfig:
    """Errors of a simulated camera at the object's size; a stereo camera's are added afterwards."""
    chosen = next((sensor for name, sensor in SENSORS.items() if name == camera), SensorConfig())
    return replace(chosen, metres_per_unit=unit_m(scene), background=0.0)


def own_view(scene: Scene, view: View, condition: str, rng: np.random.Generator) -> Observation:
    """The object as a fit is given it: a depth image with its mask, or a bare cloud."""
    if condition in ("whole", "unknown-unit"):
        cloud = view.depth.to_points()
        factor = float(np.exp(rng.uniform(-2, 2))) if condition == "unknown-unit" else 1.0
        return find_object(SensorFrame(Path(condition), PointCloud(factor * cloud.points), None, "camera"))
    if condition == "surface":
        return find_object(SensorFrame(Path(condition), stitched(view, rng), None, "camera"))
    sensor = sensor_of(scene, "structured-light" if condition == "mask2" else condition)
    if condition == "mask2":
        sensor = replace(sensor, mask_offset_px=2.0, mask_shift_px=0.0)
    kind, share = CUTS.get(condition, ("none", 0.0))
    cut = occlude(view, kind, share, rng, GenerateConfig(noise_std=0.0 if sensor.on else 0.1, sensor=sensor))
    whole, mask = cut.whole, cut.mask
    if condition == "stereo":
        whole, mask = by_stereo(whole, mask, unit_m(scene), rng)
    return masked(whole, mask)


def masked(whole: DepthImage, mask: Bool[np.ndarray, "h w"] | None) -> Observation:
    """A depth image, and what a mask leaves of it."""
    depth = whole if mask is None else DepthImage(np.where(mask, whole.depth, 0.0), whole.camera)
    frame = SensorFrame(Path("simulated"), depth.to_points(), None, "camera", depth, whole=whole)
    return find_object(frame, IsolationConfig())


def stitched(view: View, rng: np.random.Generator, cameras: int = 3, points: int = 2500) -> PointCloud:
    """Surface with normals, as a scanner stitches it from several sides, no camera's; noise is a tenth of a unit."""
    middle = view.mesh.bounds.mean(axis=0)
    size = float(np.ptp(view.mesh.bounds, axis=0).max())
    seen = list[np.ndarray]()
    for _ in range(cameras):
        away = rng.normal(size=3)
        T = look_at(middle + 4 * size * away / np.linalg.norm(away), middle, rng.normal(size=3), 0.0)
        solids = Solids(view.mesh.transformed(inverse_rigid(T)))
        image = observe(solids, Camera.from_fov(96, 96, 0.5), 0.1, SensorConfig(), rng).image
        seen.append(image.to_points().points @ T[:3, :3].T + T[:3, 3])
    every = np.concatenate(seen)
    chosen = every[rng.permutation(len(every))[:points]]
    solids = Solids(view.mesh)
    normals = solids.face_normals(solids.nearest(chosen).face)
    return PointCloud(chosen, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


# --- a stereo camera --------------------------------------------------------------------------------------------------

# Stereo cameras match windows of pixels, so that neighbours share their error, edges move by up to the window, and
# beside an edge, where one eye sees what the other does not, nothing is measured.


def smooth_field(shape: tuple[int, int], width: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Random field of standard deviation 1 whose pixels are alike over about ``width`` pixels."""
    field = ndimage.gaussian_filter(rng.normal(size=shape), width / 2, mode="reflect")
    return np.asarray(field / field.std())


def by_stereo(
    image: DepthImage, mask: Bool[np.ndarray, "h w"], metres: float, rng: np.random.Generator
) -> tuple[DepthImage, Bool[np.ndarray, "h w"]]:
    """Image as a stereo camera measures it, and its mask, off by about 2 pixels.

    Depth is off by 1 to 2.5 mm up to .7 m, alike over 10 to 30 pixels, edges by up to 4 pixels; beside edges pixels are
    missing. ``metres`` are in a unit of the image.
    """
    shape = image.depth.shape
    v, u = np.mgrid[: shape[0], : shape[1]]
    shift = [np.clip(1.6 * smooth_field(shape, rng.uniform(10, 20), rng), -4, 4) for _ in range(2)]
    rows, columns = (
        np.clip(np.rint(at + by), 0, size - 1).astype(int) for at, by, size in zip((v, u), shift, shape, strict=True)
    )
    depth = image.depth[rows, columns]
    farther = np.maximum(1.0, (depth * metres / 0.7) ** 2)  # a step of disparity is worth more there
    off = rng.uniform(1e-3, 2.5e-3) / metres * farther * smooth_field(shape, rng.uniform(10, 30), rng)
    depth = np.where(depth > 0, np.maximum(depth + off + rng.normal(0.0, 2e-4 / metres, shape), 1e-6), 0.0)
    jump = depth + np.maximum(0.02 / metres, 0.05 * depth)
    behind = ndimage.maximum_filter(depth, (1, 7), origin=(0, 3)) > jump  # to the left of what is near
    edge = ndimage.maximum_filter(depth, 3) > jump
    missing = (ndimage.binary_dilation(edge, iterations=2) | behind) & (smooth_field(shape, 6, rng) > 0.4)
    outward = ndimage.distance_transform_edt(~mask) - ndimage.distance_transform_edt(mask)
    wrong = outward < 2.0 * smooth_field(shape, 20, rng)
    return DepthImage(np.where(missing, 0.0, depth), image.camera), wrong


# --- other things -----------------------------------------------------------------------------------------------------


def as_segment(mesh: trimesh.Trimesh) -> SegmentedMesh:
    """A thing as a mesh of one segment."""
    return SegmentedMesh((Segment("thing", (128, 128, 128), np.asarray(mesh.vertices), np.asarray(mesh.faces)),))


def seen_at(mesh: SegmentedMesh, view: View, rng: np.random.Generator) -> PointCloud | None:
    """Cloud of a mesh in the camera frame by the camera of a view; None where too little of it is seen."""
    image = observe(Solids(mesh), view.depth.camera, 0.1, SensorConfig(), rng).image
    return image.to_points() if image.valid.sum() >= 4 * MIN_POINTS else None


def other_view(scene: Scene, kind: str, rng: np.random.Generator) -> Observation:
    """Cloud as large as a view of the object, that does not show it whole and once; drawn again where it is empty."""
    for _ in range(50):
        view = sample_view(scene, GenerateConfig(), rng)
        cloud = other_cloud(scene, kind, view, rng)
        if cloud is not None:
            return find_object(SensorFrame(Path(kind), cloud, None, "camera"))
    raise RuntimeError(f"no cloud of the kind {kind!r} was seen for {scene.name}")


def other_cloud(scene: Scene, kind: str, view: View, rng: np.random.Generator) -> PointCloud | None:
    """Cloud of one kind of ``OTHERS``; None where nothing is seen."""
    points = view.depth.to_points().points
    middle = view.mesh.bounds.mean(axis=0)
    size = float(np.ptp(view.mesh.bounds, axis=0).max())
    across = np.ptp(points, axis=0)[:2].argmax()
    away = points[:, across]
    if kind == "half":
        half = points[away < np.median(away)]
        return PointCloud(half) if len(half) >= 2 * MIN_POINTS else None
    if kind == "patch":
        center = points[rng.integers(len(points))]
        near = np.linalg.norm(points - center, axis=1) < 0.2 * size
        return PointCloud(points[near]) if near.sum() >= 2 * MIN_POINTS else None
    if kind == "two":
        return PointCloud(np.concatenate([points, points + 1.1 * np.ptp(away) * np.eye(3)[across]]))
    if kind == "merged":
        turn = rigid(Rotation.from_rotvec([0, np.pi, 0]).as_matrix(), np.zeros(3))
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        back = seen_at(view.mesh.transformed(turn), view, rng)
        if back is None:
            return None
        return PointCloud(np.concatenate([points, (back.points - turn[:3, 3]) @ turn[:3, :3]]))
    return seen_at(other_mesh(scene, kind, view, rng), view, rng)


def other_mesh(scene: Scene, kind: str, view: View, rng: np.random.Generator) -> SegmentedMesh:
    """Another thing, another object, or the object mirrored or of another size, where the object was."""
    middle = view.mesh.bounds.mean(axis=0)
    size = float(np.ptp(view.mesh.bounds, axis=0).max())
    if kind == "mirrored" and scene.name in CHIRAL:
        flipped = [
            replace(part, vertices=middle + (part.vertices - middle) * [-1, 1, 1], faces=part.faces[:, ::-1])
            for part in view.mesh.segments
        ]
        return SegmentedMesh(tuple(flipped))
    if kind in ("scaled", "mirrored"):
        factor = float(rng.choice([1.12, 1.2, 1.35] if kind == "scaled" else [0.88, 0.8, 0.7]))
        return view.mesh.with_vertices([middle + factor * (part.vertices - middle) for part in view.mesh.segments])
    if kind == "thing":
        mesh = as_segment(things()[rng.integers(len(things()))])
    else:
        name = str(rng.choice([each for each in OBJECTS if each != scene.name]))
        mesh = scene_of(name).sample_state(rng).mesh
    mine = mesh.bounds.mean(axis=0)
    factor = size / float(np.ptp(mesh.bounds, axis=0).max()) * rng.uniform(0.8, 1.2)
    turn = Rotation.random(rng=rng).as_matrix()
    return mesh.with_vertices([middle + factor * (part.vertices - mine) @ turn.T for part in mesh.segments])


# --- desks ------------------------------------------------------------------------------------------------------------


class Placed(NamedTuple):
    """Something that stands on a desk: its mesh in the desk's frame, z up, and how it was moved there."""

    mesh: SegmentedMesh
    T: Float[np.ndarray, "4 4"]

    @property
    def radius(self) -> float:
        """Of the upright cylinder around its axis that holds it."""
        places = np.concatenate([part.vertices[:, :2] for part in self.mesh.segments])
        return float(np.linalg.norm(places - self.mesh.bounds.mean(axis=0)[:2], axis=1).max())

    def moved(self, shift: Float[np.ndarray, "3"]) -> "Placed":
        """The same elsewhere."""
        T = rigid(np.eye(3), shift)
        return Placed(self.mesh.transformed(T), T @ self.T)


def dropped(mesh: SegmentedMesh, turn: Float[np.ndarray, "3 3"]) -> Placed:
    """A thing, turned, that touches the desk at the origin."""
    T = rigid(turn, np.zeros(3))
    placed = Placed(mesh.transformed(T), T)
    low, high = placed.mesh.bounds
    return placed.moved(-np.array([*(low + high)[:2] / 2, low[2]]))


class Thing:
    """Something in front of or beside the object, as ``surroundings`` take it."""

    def __init__(self, mesh: SegmentedMesh) -> None:
        self.solids = Solids(mesh)

    def first_hit(self, directions: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " m"], Hits]:
        """Rows of the rays from the origin that hit it, and where."""
        hits = self.solids.first_hit(directions)
        rows = np.flatnonzero(np.isfinite(hits.distance))
        return rows, Hits(hits.distance[rows], hits.normal[rows])


def things_around(size: float, inner: float, rng: np.random.Generator) -> list[Placed]:
    """Four to eight other things around the origin of a desk, none on another."""
    placed = list[Placed]()
    for _ in range(int(rng.integers(4, 9))):
        mesh = as_segment(things()[rng.integers(len(things()))])
        factor = size * rng.uniform(0.4, 1.1) / float(np.ptp(mesh.bounds, axis=0).max())
        mesh = mesh.with_vertices([factor * part.vertices for part in mesh.segments])
        thing = dropped(mesh, Rotation.random(rng=rng).as_matrix())
        for _ in range(30):
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(inner, inner + 2 * size)
            other = thing.moved(np.array([far * np.cos(angle), far * np.sin(angle), 0.0]))
            at = other.mesh.bounds.mean(axis=0)[:2]
            radius = other.radius
            apart = [np.linalg.norm(at - each.mesh.bounds.mean(axis=0)[:2]) - each.radius for each in placed]
            if np.linalg.norm(at) > inner + 0.8 * radius and all(gap > 0.9 * radius for gap in apart):
                placed.append(other)
                break
    return placed


def desk_view(scene: Scene, condition: str, number: int, rng: np.random.Generator) -> tuple[Observation, View | None]:
    """Cluttered desk before a wall, by one camera after the other; of the object at least 60 % are to be seen."""
    camera = ("paper", *CAMERAS)[number % 4]
    pixels = STEREO_WIDE if camera == "stereo" else WIDE
    image = Camera.from_fov(pixels, pixels, float(np.deg2rad(45)))
    sensor = sensor_of(scene, camera)
    for _ in range(100):
        state = scene.sample_state(rng)
        own = dropped(state.mesh, Rotation.random(rng=rng).as_matrix())
        size = float(np.ptp(own.mesh.bounds, axis=0).max())
        others = things_around(max(size, 25.0), own.radius, rng)
        elevation, azimuth, far = rng.uniform(*np.deg2rad([25, 70])), rng.uniform(0, 2 * np.pi), rng.uniform(2.8, 4.2)
        target = np.array([*rng.uniform(-0.4, 0.4, 2) * size, 0.3 * size])
        toward = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        eye = target + far * max(size, 25.0) * toward
        T = inverse_rigid(look_at(eye, target, np.array([0.0, 0.0, 1.0]), 0.0))
        up, back = T[:3, :3] @ [0.0, 0.0, 1.0], T[:3, :3] @ [-np.cos(azimuth), -np.sin(azimuth), 0.0]
        wall = Backdrop(back, float(back @ T[:3, 3]) + 3.5 * max(size, 25.0))
        if not others:
            continue
        # without the object, or with the mask of another thing, that thing is what is measured
        is_other = condition in ("desk-thing", "desk-empty")
        shown, beside = (others[0], others[1:]) if is_other else (own, others)
        beside = [own, *beside] if condition == "desk-thing" else beside
        parts: list[Occluding] = [*(Thing(each.mesh.transformed(T)) for each in beside), wall]
        solids = Solids(shown.mesh.transformed(T))
        around = surroundings(parts, Backdrop(-up, float(eye[2])))
        alone = np.isfinite(solids.first_hit(image.directions().reshape(-1, 3)).distance).sum()
        measured = observe(solids, image, 0.0 if sensor.on else 0.1, sensor, rng, around=around)
        if (measured.source == OBJECT).sum() < 0.6 * alone or alone < 4 * MIN_POINTS:
            continue
        whole, mask = measured.whole, measured.mask
        if camera == "stereo":
            whole, mask = by_stereo(whole, mask, unit_m(scene), rng)
        if condition in ("desk", "desk-thing") and (mask & whole.valid).sum() < 4 * MIN_POINTS:
            continue
        seen = masked(whole, mask if condition in ("desk", "desk-thing") else None)
        if is_other:
            return seen, None
        mesh = own.mesh.transformed(T)
        return seen, View(
            mesh, DepthImage(np.where(mask, whole.depth, 0.0), image), inverse_rigid(T @ own.T), state.deformations
        )
    raise RuntimeError(f"no desk showed {scene.name}")
