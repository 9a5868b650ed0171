"""Renderer of shaded pictures: rays by libigl, two-sided Lambert light, smooth normals, dark outlines.

It needs neither a display nor OpenGL. Notation: the view frame is x right, y down, z away from the viewer, as a
camera's.
"""

from dataclasses import dataclass
from itertools import permutations
from math import inf

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.sparse import csr_array

from mereo.geometry.camera import Camera, PixelValues, Size
from mereo.geometry.conventions import Pair
from mereo.geometry.mesh import Color, Faces, SegmentedMesh, Vertices
from mereo.geometry.solids import cast_rays, search_tree
from mereo.geometry.transforms import (
    Corners,
    Indices,
    Points,
    Transform,
    Values,
    inverse_rigid,
    look_at,
    rigid,
    transform_points,
    unit_rows,
)
from mereo.io.writers.meshes import OUTER_OPACITY

Vector = tuple[float, float, float]

SUPERSAMPLE = 2
BACKGROUND = 1.0
CREASE_COSINE = 0.6
"""Cosine of the angle, about 53 degrees, from which on an edge is not smoothed: cuts and box edges stay sharp."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Virtual camera of a picture: orthographic with ``half_size``, or a pinhole with ``camera``.

    Attributes:
        T_view_world: rigid transform from the frame of the things shown to the view frame.
        half_size: half the picture's shorter side, in units; used when ``camera`` is None.
        camera: intrinsics, scaled to the picture's width.
    """

    T_view_world: Transform
    half_size: float = 1.0
    camera: Camera | None = None

    @classmethod
    def along(
        cls,
        bounds: Corners,
        direction: Vector,
        up: Vector,
        margin: float = 1.08,
    ) -> "Viewpoint":
        """Orthographic view along ``direction``, with ``up`` upwards, that shows the whole box ``bounds``."""
        turned = look_at(np.zeros(3), np.asarray(direction, float), np.asarray(up, float))
        rotation = inverse_rigid(turned)[:3, :3]
        half = np.abs(rotation[:2]) @ (bounds[1] - bounds[0]) / 2
        return cls(rigid(rotation, -rotation @ bounds.mean(axis=0)), margin * max(float(half.max()), 1e-12))

    @classmethod
    def through(cls, camera: Camera, T_world_camera: Transform | None = None) -> "Viewpoint":
        """View of what a camera sees; by default things are in the camera's own frame."""
        return cls(np.eye(4) if T_world_camera is None else inverse_rigid(T_world_camera), camera=camera)

    def apply(self, points: Points) -> Points:
        """Points in the view frame."""
        return transform_points(self.T_view_world, points)

    def pixels(self, points_view: Points, width: int, height: int) -> Float[ndarray, "n 2"]:
        """Column and row (pixel centres at +0.5) of points in the view frame."""
        if self.camera is not None:
            return self.camera.project(points_view) * [width / self.camera.width, height / self.camera.height]
        scale = min(width, height) / (2 * self.half_size)
        return points_view[:, :2] * scale + [width / 2, height / 2]

    def rays(self, width: int, height: int, back_off: float) -> tuple[ndarray, ndarray]:
        """Origins and directions (z = 1) in the view frame through every pixel centre, row by row."""
        grid_y, grid_x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
        pixel = np.stack([grid_x.ravel(), grid_y.ravel()], axis=-1)
        count = width * height
        if self.camera is not None:
            scaled = pixel * [self.camera.width / width, self.camera.height / height]
            return np.zeros((count, 3)), self.camera.unproject(scaled, np.ones(count))
        plane = (pixel - [width / 2, height / 2]) * (2 * self.half_size / min(width, height))
        origins = np.column_stack([plane, np.full(count, -back_off)])
        return origins, np.tile([0.0, 0.0, 1.0], (count, 1))


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles as the renderer draws them: one colour each, and a normal at each corner.

    Attributes:
        vertices: positions of the corners.
        faces: vertex indices of each triangle.
        colors: red, green, blue in 0..1 for each face.
        normals: unit normals at the three corners of each face; their sign is of no consequence.
        owner: number of the part that each face belongs to; an outline is drawn where it changes.
    """

    vertices: Vertices
    faces: Faces
    colors: Float[ndarray, "f 3"]
    normals: Float[ndarray, "f 3 3"]
    owner: Int[ndarray, " f"]

    @classmethod
    def of(cls, mesh: SegmentedMesh, colors: list[Color] | None = None) -> "Triangles":
        """Triangles of all segments in their colours, or in ``colors``, one for each segment."""
        vertices, faces, owner = mesh.merged()
        palette = np.asarray(mesh.colors if colors is None else colors, float).reshape(-1, 3) / 255.0
        return cls(vertices, faces, palette[owner], corner_normals(vertices, faces), owner)


def corner_normals(vertices: Vertices, faces: Faces) -> Float[ndarray, "f 3 3"]:
    """Normal at each corner of each face: the mean, weighted by angle, of those faces there that no crease parts."""
    edges = [unit_rows(vertices[np.roll(faces, -k, axis=1)] - vertices[faces]) for k in (1, 2)]
    angle = np.arccos(np.clip((edges[0] * edges[1]).sum(axis=-1), -1, 1)).ravel()
    flat = np.repeat(unit_rows(np.cross(edges[0][:, 0], edges[1][:, 0])), 3, axis=0)
    corners = np.arange(faces.size)
    at_vertex = csr_array((np.ones(faces.size), (corners, faces.ravel())), shape=(faces.size, len(vertices)))
    pairs = (at_vertex @ at_vertex.T).tocoo()
    same = (flat[pairs.row] * flat[pairs.col]).sum(axis=1) > CREASE_COSINE
    row, col = pairs.row[same], pairs.col[same]
    weights = csr_array((angle[col], (row, col)), shape=pairs.shape)
    return unit_rows(weights @ flat).reshape(-1, 3, 3)


@dataclass(frozen=True, eq=False)
class Canvas:
    """Picture in the making at ``SUPERSAMPLE`` times its size: colours in 0..1 and depth (infinite where empty)."""

    view: Viewpoint
    rgb: Float[ndarray, "h w 3"]
    depth: PixelValues

    @classmethod
    def empty(cls, view: Viewpoint, size: Size) -> "Canvas":
        """Blank picture; ``size`` is (width, height) when it is finished."""
        shape = (size[1] * SUPERSAMPLE, size[0] * SUPERSAMPLE)
        return cls(view, np.full((*shape, 3), BACKGROUND), np.full(shape, inf))

    def draw_triangles(self, shown: Triangles) -> None:
        """Draw triangles where they are nearer than everything drawn before."""
        height, width = self.depth.shape
        vertices = self.view.apply(shown.vertices)
        normals = shown.normals @ self.view.T_view_world[:3, :3].T
        back_off = 2 * float(np.abs(vertices).max(initial=1e-6))
        origins, directions = self.view.rays(width, height, back_off)
        face, distance, bary = _cast(vertices, shown.faces, origins, directions)
        z = (origins[:, 2] + distance).reshape(height, width)
        nearer = (face >= 0) & (z.ravel() < self.depth.ravel())
        index = np.flatnonzero(nearer)
        normal = unit_rows(np.einsum("nk,nkd->nd", bary[index], normals[face[index]]))
        light = _light(normal, unit_rows(directions[index]))
        rgb = self.rgb.reshape(-1, 3)
        depth = self.depth.reshape(-1)
        rgb[index] = np.clip(shown.colors[face[index]] * light[:, :1] + light[:, 1:], 0, 1)
        depth[index] = z.ravel()[index]
        part = np.where(nearer, np.append(shown.owner, -1)[face], -1).reshape(height, width)
        self._outline(part)

    def _outline(self, part: Int[ndarray, "h w"]) -> None:
        """Darken pixels next to another part or next to the background."""
        edge = np.zeros(part.shape, bool)
        for axis in (0, 1):
            for step in (1, -1):
                edge |= part != np.roll(part, step, axis=axis)
        self.rgb[edge & (part >= 0)] *= 0.45

    def draw_points(self, points: Points, colors: Points, radius_px: float = 1.2) -> None:
        """Draw points as small discs, hidden by whatever is nearer."""
        height, width = self.depth.shape
        in_view = self.view.apply(points)
        if self.view.camera is not None:
            colors, in_view = colors[in_view[:, 2] > 0], in_view[in_view[:, 2] > 0]
        center = self.view.pixels(in_view, width, height)
        radius = radius_px * SUPERSAMPLE
        steps = np.arange(-int(radius), int(radius) + 1)
        # all discs, far to near, so that the nearest is written last
        order = np.argsort(-in_view[:, 2], kind="stable")
        corner = np.floor(center[order]).astype(np.int64)
        z = in_view[order, 2]
        for dx, dy in ((x, y) for x in steps for y in steps if x * x + y * y <= radius * radius):
            self._put(corner + np.array([dx, dy]), z, colors[order])

    def _put(self, at: Int[ndarray, "n 2"], z: Values, colors: Points) -> None:
        """Single pixels, ordered far to near."""
        height, width = self.depth.shape
        inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        column, row = at[inside].T
        visible = z[inside] <= self.depth[row, column]
        column, row = column[visible], row[visible]
        self.rgb[row, column] = colors[inside][visible]
        self.depth[row, column] = z[inside][visible]

    def let_through(self, inner: "Canvas") -> None:
        """Mix in what another canvas of the same view shows behind what is drawn here."""
        hidden = np.isfinite(inner.depth) & (inner.depth > self.depth + 1e-6)
        self.rgb[hidden] = OUTER_OPACITY * self.rgb[hidden] + (1 - OUTER_OPACITY) * inner.rgb[hidden]

    def picture(self) -> UInt8[ndarray, "h w 3"]:
        """Finished picture, averaged down to the requested size."""
        height, width = (side // SUPERSAMPLE for side in self.depth.shape)
        blocks = self.rgb.reshape(height, SUPERSAMPLE, width, SUPERSAMPLE, 3)
        return np.rint(255 * blocks.mean(axis=(1, 3))).astype(np.uint8)


def _cast(
    vertices: Vertices,
    faces: Faces,
    origins: Points,
    directions: Points,
) -> tuple[Indices, Values, Points]:
    """For each ray the first face (-1: none), the distance in lengths of its direction, barycentric weights."""
    if len(faces) == 0:
        return np.full(len(origins), -1), np.full(len(origins), inf), np.zeros((len(origins), 3))
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    face, share, place = cast_rays(search_tree(vertices, faces), vertices, faces, origins, directions)
    place[face < 0] = 0.0  # else it is whatever was in memory
    weights = np.concatenate([1 - place.sum(axis=1, keepdims=True), place], axis=1)
    return face, np.where(face >= 0, share, inf), weights


def enclosed(mesh: SegmentedMesh) -> set[Pair]:
    """Pairs (inner, outer) of segments' indices: those declared nested, and those of which one is around the other.

    It is around a point where it is met from there in six directions, along the axes and against them. So it may have
    holes, or the other one's shape as a cavity. A segment without faces is in none.
    """
    solid = [(index, segment) for index, segment in enumerate(mesh.segments) if len(segment.faces)]
    pairs = {(inner, outer) for inner, outer in mesh.nesting if len(mesh.segments[inner].faces)}
    for (inner, part), (outer, around) in permutations(solid, 2):
        (low, high), (least, most) = part.bounds, around.bounds
        if (least <= low).all() and (high <= most).all():
            places = part.vertices[:: 1 + len(part.vertices) // 200]
            ways = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (len(places), 1))
            if (_cast(around.vertices, around.faces, np.repeat(places, 6, axis=0), ways)[0] >= 0).all():
                pairs.add((inner, outer))
    return pairs


def opacities(mesh: SegmentedMesh) -> list[float]:
    """Opacity of each segment: ``OUTER_OPACITY`` around another one, which would never be seen, else 1."""
    outer = {index for _, index in enclosed(mesh)}
    return [OUTER_OPACITY if index in outer else 1.0 for index in range(len(mesh.segments))]


def _light(normal: Points, ray: Points) -> Float[ndarray, "n 2"]:
    """Diffuse factor and added highlight: a key light from above left, a fill from the viewer, some ambient."""
    facing = np.where((normal * ray).sum(axis=1, keepdims=True) > 0, -normal, normal)
    key = unit_rows(np.array([-0.5, -0.8, -0.9]))
    diffuse = 0.34 + 0.52 * np.clip(facing @ key, 0, 1) + 0.26 * np.clip(-facing[:, 2], 0, 1)
    highlight = 0.16 * np.clip(facing @ unit_rows(key - np.array([0.0, 0.0, 1.0])), 0, 1) ** 24
    return np.stack([diffuse, highlight], axis=1)


def shade(
    mesh: SegmentedMesh, view: Viewpoint, size: Size, colors: list[Color] | None = None
) -> UInt8[ndarray, "h w 3"]:
    """Shaded picture of ``size`` (width, height) pixels on white, each segment in its colour (or ``colors``).

    Segments inside others shine through them (``enclosed``).
    """
    return shaded_canvas(mesh, view, size, colors).picture()


def shaded_canvas(mesh: SegmentedMesh, view: Viewpoint, size: Size, colors: list[Color] | None = None) -> Canvas:
    """``shade`` before it is finished: more can be drawn on it."""
    canvas = Canvas.empty(view, size)
    colors = list(mesh.colors) if colors is None else colors
    canvas.draw_triangles(Triangles.of(mesh, colors))
    if inner := sorted({index for index, _ in enclosed(mesh)}):
        within = Canvas.empty(view, size)
        parts = SegmentedMesh(tuple(mesh.segments[index] for index in inner))
        within.draw_triangles(Triangles.of(parts, [colors[index] for index in inner]))
        canvas.let_through(within)
    return canvas
