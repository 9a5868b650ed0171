"""The whole path in nine seconds, as a moving picture: a model, a depth frame of it bent, and where its segments are.

    python examples/loop.py --output loop.webp

The bunny goes once round a circle through states of a test seed (needs the asset `bunny/bunny.off`). mereo gets the
meshes of the model at rest and the depth images; no network is loaded. It searches the frame in which the object comes
to rest, and follows the object from there. While the object rests its cloud turns, which shows that the back is empty,
and the segments fill it from the seen side to the hidden one.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from mereo.api.objects import load_object
from mereo.api.reconstruct import Tracker
from mereo.deformation.maps import turn
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import mesh_of, solid_of
from mereo.geometry.transforms import inverse_rigid, look_at, transform_points
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.scenes.draw_recorder import Recorder
from mereo.scenes.parameters import Played, play, random_state, turned
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth
from mereo.visualization.color_scales import viridis
from mereo.visualization.contact_sheets import INK, Picture, depth_to_rgb, fit_font, font
from mereo.visualization.renderer import Canvas, Triangles, Viewpoint

SCENE, SEED, NOISE_STD = "bunny", 1_000_007, 0.1
"""The last is the sensor's noise in scene units, the paper's."""

SECONDS, STILL, FILL, MOVE = 9.0, 2.8, 4.9, 6.3
"""Its length, and when the object comes to rest, when the segments begin to fill the cloud, when it moves on."""

FADE, BLINK = 0.7, 0.3
"""Seconds in which the segments become the first cloud again, and in which one caption becomes the next."""

REST = 0.12
"""Where on the circle of states the object rests: bent, so that the model at rest beside it is another shape."""

SENSOR_PIXELS, VIEW_UNITS, DISTANCE = 100, 37.0, 120.0
"""Of the camera: pixels and scene units across its picture, and its distance from ``MIDDLE``."""

MIDDLE, UP = np.array([-1.5, -0.3, 0.0]), np.array([0.0, 1.0, 0.0])
AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(-15.0), np.deg2rad(15.0)
SIDE, GAP, HEAD, FOOT = 300, 15, 42, 34
"""In pixels: each of the three pictures, between them, the captions above them, and the names below."""

INNER = np.array([0.70, 0.71, 0.74])
"""The inner side of the shell of points, which nothing has seen."""

CAPTIONS = ("its points: one side only", "the back is empty", "mereo: every part, back included")


@dataclass(frozen=True, eq=False)
class Moment:
    """What there is at one time.

    Attributes:
        mesh: the true object, in the camera frame.
        depth: what the camera measures.
    """

    mesh: SegmentedMesh
    depth: DepthImage


def smooth(value: float) -> float:
    """From 0 to 1 with a gentle start and end."""
    share = min(max(value, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


# --- the object and its camera ----------------------------------------------------------------------------------------


def turn_at(time: float) -> float:
    """Where on the circle of states the object is: half a turn, a rest, half a turn; 1 is 0 again."""
    first = min(time / STILL, 1.0)
    second = max((time - MOVE) / (SECONDS - MOVE), 0.0)
    return (REST - 0.5 * (1.0 - first) ** 2 + 0.5 * second**2) % 1.0


def mesh_at(scene: Scene, played: Played, turn: float) -> SegmentedMesh:
    """The object with all draws of its state moved at once; each stays as likely as it was."""
    shares = {call.key: turned(call.shares, turn, SEED + index) for index, call in enumerate(played.calls)}
    return scene.deform(play(scene, Recorder(SEED, shares))).mesh


def camera_pose() -> Float[np.ndarray, "4 4"]:
    """``T_world_camera``."""
    across = np.cos(ELEVATION_RAD)
    up = np.sin(ELEVATION_RAD)
    away = np.array([across * np.sin(AZIMUTH_RAD), up, across * np.cos(AZIMUTH_RAD)])
    return look_at(MIDDLE + DISTANCE * away, MIDDLE, UP)


def camera() -> Camera:
    """The depth camera, as wide as ``VIEW_UNITS`` at the object."""
    return Camera.from_fov(SENSOR_PIXELS, SENSOR_PIXELS, float(2 * np.arctan(VIEW_UNITS / 2 / DISTANCE)))


def moment(scene: Scene, played: Played, turn: float) -> Moment:
    """The state at ``turn``, and its depth; the noise is the same every time, so that the picture does not flicker."""
    mesh = mesh_at(scene, played, turn).transformed(inverse_rigid(camera_pose()))
    return Moment(mesh, add_depth_noise(render_depth(mesh, camera()), NOISE_STD, np.random.default_rng(SEED)))


# --- the right picture ------------------------------------------------------------------------------------------------


def orbit(yaw_rad: float) -> Viewpoint:
    """An orthographic view of the camera frame, turned about the scene's vertical axis; 0 is the camera's own."""
    forward = transform_points(inverse_rigid(camera_pose()), np.stack([MIDDLE, MIDDLE + UP]))
    axis = forward[1] - forward[0]
    middle = forward[0]
    eye = turn(np.zeros((1, 3)), middle, axis, np.array([yaw_rad]))[0]
    return Viewpoint(inverse_rigid(look_at(eye, middle, axis)), VIEW_UNITS / 2 * 1.02)


def outward(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud toward the camera: the least spread direction of 24 neighbours."""
    around = points[cKDTree(points).query(points, 24)[1]]
    centered = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))[1][:, :, 0]
    facing = np.sign(-(normals * points).sum(axis=1, keepdims=True))
    return normals * facing


def draw_shell(canvas: Canvas, points: Float[np.ndarray, "n 3"], behind: float = -np.inf) -> None:
    """Points by depth where their seen side faces the viewer, grey where it is turned away.

    Only those farther from the camera than ``behind`` are drawn.
    """
    z = points[:, 2]
    nearness = 1 - (z - z.min()) / np.ptp(z)
    colors = viridis(nearness) / 255
    slope = -(outward(points) @ canvas.view.T_view_world[2, :3])
    seen = np.clip(0.5 + 2.5 * slope, 0, 1)[:, None]
    shown = seen * colors * (0.72 + 0.28 * np.clip(slope, 0, 1)[:, None]) + (1 - seen) * INNER
    canvas.draw_points(points[z > behind], shown[z > behind], 1.25)


def cut(surfaces: SegmentedMesh, depth: float) -> SegmentedMesh:
    """What lies nearer to the camera than ``depth``, closed by its cross-section."""
    found = [s for s in surfaces.segments if len(s.faces) and s.vertices[:, 2].min() < depth]
    parts = []
    for segment in found:
        solid = solid_of(segment.vertices, segment.faces).trim_by_plane((0.0, 0.0, -1.0), -depth)
        parts.append(Segment(segment.name, segment.color, *mesh_of(solid)))
    return SegmentedMesh(tuple(parts))


# --- pictures ---------------------------------------------------------------------------------------------------------


def ramp(time: float, start: float, seconds: float) -> float:
    """From 0 to 1, gently, within ``seconds`` from ``start`` on."""
    return smooth((time - start) / seconds)


def writing(texts: Sequence[tuple[str, float]]) -> Image.Image:
    """Captions on one place, each with its strength in 0..1."""
    plate = Image.new("RGB", (SIDE, HEAD), "white")
    for text, strength in texts:
        ink = tuple(round(255 + strength * (part - 255)) for part in INK)
        pen = ImageDraw.Draw(plate)
        if strength > 0:
            pen.text((SIDE // 2, HEAD // 2), text, fill=ink, font=fit_font(19, text, SIDE), anchor="mm")
    return plate


def titles(time: float) -> list[tuple[str, float]]:
    """The right picture's caption; one fades out before the next fades in."""
    since = (-BLINK, STILL, FILL, SECONDS - FADE)
    shown = []
    for text, start, end in zip((*CAPTIONS, CAPTIONS[0]), since, (*since[1:], SECONDS + FADE), strict=True):
        shown.append((text, ramp(time, start, BLINK) - ramp(time, end - BLINK, BLINK)))
    return shown


@cache
def arrow() -> Image.Image:
    """What stands between two pictures."""
    plate = Image.new("RGB", (4 * GAP, 96), "white")
    ImageDraw.Draw(plate).line([(16, 16), (44, 48), (16, 80)], fill=(150, 155, 163), width=9, joint="curve")
    return plate.resize((GAP, 24), Image.Resampling.LANCZOS)


def names(mesh: SegmentedMesh) -> Image.Image:
    """A dot and a name for each segment, in the middle of one line."""
    texts = [segment.name.replace("_", " ") for segment in mesh.segments]
    lengths = [24 + int(font(13).getlength(text)) for text in texts]
    plate = Image.new("RGB", (SIDE, FOOT), "white")
    pen = ImageDraw.Draw(plate)
    x = (SIDE - sum(lengths)) // 2 + 4
    y = FOOT // 2
    for segment, text, length in zip(mesh.segments, texts, lengths, strict=True):
        pen.ellipse((x, y - 5, x + 10, y + 5), fill=segment.color)
        pen.text((x + 14, y), text, fill=INK, font=font(13), anchor="lm")
        x += length
    return plate


class Loop:
    """All frames, drawn in the order of time: an answer follows from the one before."""

    def __init__(self) -> None:
        self.scene = load_scene(SCENE)
        self.tracker = Tracker(load_object(self.scene), "modes")
        self.played = random_state(self.scene, SEED)
        start = moment(self.scene, self.played, 0.0).depth
        seen = start.depth[start.valid]
        self.limits = float(seen.min()) - 1.0, float(seen.max()) + 1.0

    @cache  # noqa: B019 (one object for the whole program)
    def moment(self, turn: float) -> Moment:
        return moment(self.scene, self.played, turn)

    @cache  # noqa: B019
    def surfaces(self, turn: float, time: float) -> SegmentedMesh:
        return self.tracker.follow(self.moment(turn).depth, time).surfaces

    def registered(self, time: float) -> Picture:
        """The segments, up to the depth to which they have filled the cloud, and the rest of the cloud."""
        now = turn_at(time)
        canvas = Canvas.empty(orbit(yaw_at(time)), (SIDE, SIDE))
        surfaces = self.surfaces(now, max(time, MOVE))  # it rests until then
        low, high = surfaces.bounds[:, 2]
        behind = low + (high - low + 0.1) * ramp(time, FILL, MOVE - FILL)
        canvas.draw_triangles(Triangles.of(cut(surfaces, behind) if time < MOVE else surfaces))
        if time < MOVE:
            draw_shell(canvas, self.moment(now).depth.to_points().points, behind)
        return canvas.picture()

    def measured(self, time: float) -> Picture:
        """The cloud."""
        canvas = Canvas.empty(orbit(yaw_at(time)), (SIDE, SIDE))
        draw_shell(canvas, self.moment(turn_at(time)).depth.to_points().points)
        return canvas.picture()

    def result(self, time: float) -> Image.Image:
        """The cloud, the segments that fill it, and in the end the cloud again."""
        if time <= FILL:
            return Image.fromarray(self.measured(time))
        segments = Image.fromarray(self.registered(time))
        back = ramp(time, SECONDS - FADE, FADE)
        return Image.blend(segments, Image.fromarray(self.measured(time)), back) if back > 0 else segments

    def frame(self, time: float) -> Image.Image:
        """All three pictures with their captions."""
        now = self.moment(turn_at(time))
        model = Canvas.empty(orbit(2 * np.pi * time / SECONDS), (SIDE, SIDE))
        model.draw_triangles(Triangles.of(self.scene.rest.transformed(inverse_rigid(camera_pose()))))
        depth = Image.fromarray(depth_to_rgb(now.depth, self.limits)).resize((SIDE, SIDE), Image.Resampling.NEAREST)
        pictures = (Image.fromarray(model.picture()), depth, self.result(time))
        captions = ([("your model at rest", 1.0)], [("a depth frame: the object bends", 1.0)], titles(time))
        sheet = Image.new("RGB", (4 * GAP + 3 * SIDE, HEAD + SIDE + FOOT), "white")
        for index, (picture, texts) in enumerate(zip(pictures, captions, strict=True)):
            x = GAP + index * (SIDE + GAP)
            sheet.paste(writing(texts), (x, 0))
            sheet.paste(picture, (x, HEAD))
            if index > 0:
                sheet.paste(arrow(), (x - GAP, HEAD + SIDE // 2 - 12))
        sheet.paste(names(self.scene.rest), (GAP, HEAD + SIDE))
        return sheet


def yaw_at(time: float) -> float:
    """How far the right picture has turned: not while the cloud is like the depth image, then once around."""
    return 2 * np.pi * smooth((time - STILL + 0.5) / (SECONDS - FADE - STILL + 0.5))


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the path from a model and a frame to all segments as a loop.")
    parser.add_argument("--output", type=Path, default=Path("loop.webp"), help="the animated WebP to write")
    parser.add_argument("--fps", type=float, default=20.0, help="frames per second")
    parser.add_argument("--force", action="store_true", help="replace the file where it exists")
    options = parser.parse_args()
    try:
        check_file_place(options.output, force=options.force)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    loop = Loop()
    frames = [loop.frame(number / options.fps) for number in range(round(SECONDS * options.fps))]
    with atomic_file(options.output, force=options.force) as partial:
        ms = round(1000 / options.fps)
        frames[0].save(partial, "WEBP", save_all=True, append_images=frames[1:], duration=ms, quality=72, method=6)
    print(f"wrote {options.output}: {len(frames)} frames, {options.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
