"""Pinhole cameras, depth images, point clouds, and lines of sight that passed the object.

Notation: the camera frame is OpenCV/ROS optical, x right, y down, z forward. Depth is z, not ray length. The centre of
pixel (column u, row v) is at (u + 0.5, v + 0.5). ``unproject`` and ``project`` are each other's inverse.
"""

from dataclasses import dataclass, replace
from math import inf
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.linalg import norm
from numpy.typing import ArrayLike

from mereo.geometry.brief import counted, sides
from mereo.geometry.conventions import CloudAxes, check_real
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import (
    AnyPoints,
    Flags,
    Normalizer,
    Points,
    Rows,
    Transform,
    Values,
    rigid,
    transform_points,
    unit_rows,
)

Size = tuple[int, int]
"""Width and height of an image in pixels."""

PixelValues = Float[ndarray, "h w"]
"""A number for each pixel."""

PixelMask = Bool[ndarray, "h w"]
"""Whether each pixel is meant."""


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics in pixels.

    Attributes:
        width, height: image size in pixels.
        focal_x_px, focal_y_px: focal lengths.
        center_x_px, center_y_px: principal point, where the centre of the first pixel is at (0.5, 0.5). OpenCV, ROS,
            RealSense and Open3D put it at (0, 0): for their numbers take ``from_K``, or add 0.5. Files of them are
            read as their programs mean them (``mereo.read_camera``).
    """

    width: int
    height: int
    focal_x_px: float
    focal_y_px: float
    center_x_px: float
    center_y_px: float

    def __post_init__(self) -> None:
        size = self.width, self.height
        if not all(isinstance(side, int | np.integer) and not isinstance(side, bool) and side > 0 for side in size):
            raise ValueError(
                f"image size is {self.width} x {self.height}; both must be positive whole numbers: check the intrinsics"
            )
        check_real(np.array([self.focal_x_px, self.focal_y_px, self.center_x_px, self.center_y_px]), "the camera")
        if not (0 < self.focal_x_px < inf and 0 < self.focal_y_px < inf):
            raise ValueError(
                f"focal length is {self.focal_x_px} x {self.focal_y_px} pixels; both must be positive: "
                "check the intrinsics file"
            )
        if not (np.isfinite(self.center_x_px) and np.isfinite(self.center_y_px)):
            raise ValueError("the principal point is not finite; check the intrinsics file")

    @property
    def focal_px(self) -> float:
        """The shorter focal length, by which a pixel is as wide as it is anywhere, in pixels."""
        return min(self.focal_x_px, self.focal_y_px)

    @classmethod
    def from_fov(cls, width: int, height: int, fov_rad: float) -> "Camera":
        """Camera of square pixels, principal point in the middle, ``fov_rad`` the full horizontal angle of view."""
        focal_px = 0.5 * width / float(np.tan(0.5 * fov_rad))
        return cls(width, height, focal_px, focal_px, 0.5 * width, 0.5 * height)

    @classmethod
    def from_K(cls, K: ArrayLike, width: int, height: int) -> "Camera":
        """Camera of a matrix as OpenCV and ROS state it (``CameraInfo.k``), for an image of this size in pixels.

        There pixel centres are whole numbers, so 0.5 is added to the principal point. Raises ``ValueError`` for
        anything but 3 x 3 real numbers, or 9 row by row, with 0 0 1 in the last row.
        """
        matrix = np.asarray(K)
        check_real(matrix, "the camera matrix")
        if matrix.size != 9 or matrix.reshape(3, 3)[2].tolist() != [0, 0, 1]:
            raise ValueError(
                f"the camera matrix is {matrix.tolist()}; it must be 3 x 3 numbers with 0 0 1 in the last row: give K "
                "as OpenCV and ROS have it, row by row"
            )
        (focal_x, _, center_x), (_, focal_y, center_y), _ = matrix.reshape(3, 3).astype(float).tolist()
        return cls(width, height, focal_x, focal_y, center_x + 0.5, center_y + 0.5)

    def directions(self) -> Float[ndarray, "h w 3"]:
        """Rays through the pixel centres, scaled to z = 1, so that depth times direction is the point."""
        x = (np.arange(self.width) + 0.5 - self.center_x_px) / self.focal_x_px
        y = (np.arange(self.height) + 0.5 - self.center_y_px) / self.focal_y_px
        grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
        return np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1)

    def project(self, points: Points) -> Float[ndarray, "n 2"]:
        """Pixel coordinates (u, v) of points in the camera frame, z > 0."""
        u = self.focal_x_px * points[:, 0] / points[:, 2] + self.center_x_px
        v = self.focal_y_px * points[:, 1] / points[:, 2] + self.center_y_px
        return np.stack([u, v], axis=-1)

    def unproject(self, pixels: Float[ndarray, "n 2"], depth: Values) -> Points:
        """Points in the camera frame from pixel coordinates and depth (z)."""
        x = (pixels[:, 0] - self.center_x_px) / self.focal_x_px * depth
        y = (pixels[:, 1] - self.center_y_px) / self.focal_y_px * depth
        return np.stack([x, y, depth], axis=-1)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Observed surface points in the camera frame, in the sensor's units. Order carries no meaning.

    Attributes:
        points: their positions.
        normals: unit vectors out of the surface at each of them; None where the source has none. They matter for a
            surface that no single camera saw, and tell that one is (``IsolationConfig.extent``).
    """

    points: Points
    normals: AnyPoints | None = None

    @classmethod
    def of(cls, rows: Rows) -> "PointCloud":
        """Cloud of rows with three numbers, or with six where a normal of any length follows each position."""
        if rows.shape[1] == 3:
            return cls(rows)
        return cls(rows[:, :3].copy(), unit_rows(rows[:, 3:]))

    def __post_init__(self) -> None:
        if self.normals is not None and np.shape(self.normals) != np.shape(self.points):
            raise ValueError(
                f"there are {len(self.normals)} normals and {len(self.points)} points; each point needs one, of three "
                "numbers: give arrays of the same shape"
            )
        check_real(self.points, "the point cloud")
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"the points have the shape {self.points.shape}; they must be n x 3: give rows of x, y, z")
        if not np.isfinite(self.points).all():
            bad = int((~np.isfinite(self.points).all(axis=1)).sum())
            raise ValueError(f"{bad} of {len(self.points)} points are NaN or infinite; drop them before reconstructing")

    def __len__(self) -> int:
        return len(self.points)

    def rows(self, keep: Flags) -> "PointCloud":
        """Some of the points; the cloud itself where these are all."""
        if keep.all():
            return self
        return PointCloud(self.points[keep], None if self.normals is None else self.normals[keep])

    def transformed(self, T_new_old: Transform) -> "PointCloud":
        """The same in another frame."""
        normals = None if self.normals is None else self.normals @ T_new_old[:3, :3].T
        return PointCloud(transform_points(T_new_old, self.points), normals)

    def __repr__(self) -> str:
        return f"PointCloud({counted(len(self), 'point')}, {sides(self.points)})"


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Image of depths along z; 0 means no measurement.

    Attributes:
        depth: in the sensor's units, finite and not negative.
        camera: the intrinsics it was taken with.
    """

    depth: PixelValues
    camera: Camera

    def __post_init__(self) -> None:
        check_real(self.depth, "the depth image")
        if self.depth.ndim != 2:
            raise ValueError(
                f"the depth image has the shape {self.depth.shape}; it must be rows of pixels: give h x w values"
            )
        expected = (self.camera.height, self.camera.width)
        if self.depth.shape != expected:
            raise ValueError(
                f"the depth image is {self.depth.shape[1]} x {self.depth.shape[0]} pixels but the intrinsics say "
                f"{expected[1]} x {expected[0]}; they must agree: use the intrinsics of this stream, at this resolution"
            )
        if not np.isfinite(self.depth).all() or (self.depth < 0).any():
            raise ValueError("the depth image has negative, NaN or infinite values; use 0 where nothing was measured")

    def __repr__(self) -> str:
        measured = self.depth[self.valid]
        depths = f", depth {measured.min():.4g} to {measured.max():.4g}" if len(measured) else ""
        return f"DepthImage({self.camera.width} x {self.camera.height} pixels, {len(measured):,} measured{depths})"

    @property
    def valid(self) -> PixelMask:
        """Pixels with a measurement."""
        return self.depth > 0

    def from_ray_lengths(self) -> "DepthImage":
        """Image of depths along z, of this one whose values are distances from the camera along each pixel's ray."""
        return DepthImage(self.depth / norm(self.camera.directions(), axis=-1), self.camera)

    def to_points(self, mask: PixelMask | None = None) -> PointCloud:
        """Point cloud of every measured pixel (inside ``mask`` when given), row by row.

        Raises ``ValueError`` for a mask of another size, or of anything but truth values.
        """
        if mask is not None and (mask.shape != self.depth.shape or mask.dtype != np.bool_):
            raise ValueError(
                f"the mask has the shape {mask.shape} and type {mask.dtype}; it must be {self.depth.shape} truth "
                "values as the depth image: give for example mask > 0"
            )
        keep = self.valid if mask is None else self.valid & mask
        points = self.camera.directions()[keep] * self.depth[keep][:, None]
        return PointCloud(points.astype(float))


# --- lines of sight ---------------------------------------------------------------------------------------------------

# A line of sight is of one of three kinds (docs/registration.md): it met the *object*; it went *past* it, to something
# farther away, so that the space before that is empty; or it is *unknown*: something nearer hides what is behind,
# nothing was measured, or it lies outside the picture.

SightKind = Literal["past", "unknown", "none"]
"""Kind of a line of sight that did not meet the object: *none* of a surface that no single camera saw."""


class SharedNoise(NamedTuple):
    """What neighbours share of a camera's noise, by what was measured around the object.

    Attributes:
        std: standard deviation, at the object; infinite where the frame does not say.
        side: of the square over which they share it, as an angle.
        pixel: angle between neighbouring pixels of the camera.
    """

    std: float = inf
    side: float = 0.0
    pixel: float = 0.0


NOT_KNOWN = SharedNoise()
"""That of a frame that does not say."""


@dataclass(frozen=True, eq=False)
class SightLines:
    """Lines of sight around the object, in the frame, axes and unit of its points.

    Attributes:
        past: points beside the object, in front of it or behind; the space between the camera and each is empty.
        unknown: points anywhere on lines of sight along which nothing is known.
        other_lines: kind of all lines of sight that none of these points, and none of the object's, is near; None where
            the frame does not say, as a bare cloud does not, and then a fit has to decide.
        shared_noise: of the camera.
    """

    past: Float[ndarray, "p 3"]
    unknown: Float[ndarray, "u 3"]
    other_lines: SightKind | None = None
    shared_noise: SharedNoise = NOT_KNOWN

    @classmethod
    def of_cloud(cls, other_lines: SightKind | None = None) -> "SightLines":
        """Lines of sight around a bare cloud, all of one kind, or of an undecided one."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), other_lines)

    def with_unknown(self, points: Points) -> "SightLines":
        """The same with nothing known along the lines of sight to further points."""
        return replace(self, unknown=np.concatenate([points, self.unknown]))

    def transformed(self, T_new_old: Transform) -> "SightLines":
        """Lines of sight in another frame, whose origin is the camera as well."""
        past, unknown = (transform_points(T_new_old, points) for points in (self.past, self.unknown))
        return replace(self, past=past, unknown=unknown)

    def scaled(self, factor: float) -> "SightLines":
        """Lines of sight in another unit."""
        shared = self.shared_noise._replace(std=factor * self.shared_noise.std)
        return replace(self, past=self.past * factor, unknown=self.unknown * factor, shared_noise=shared)


# --- scanners' axes ---------------------------------------------------------------------------------------------------

SCANNER_TO_CAMERA = read_only(np.diag([1.0, -1.0, -1.0]))
"""Half a turn about x: from a scanner's axes to a camera's, and back."""

VIEW_DISTANCE = 8.5
"""Assumed distance of a scanner, in half longest sides of the visible part; 7 to 16 give the same IoU to 0.002."""


def into_camera(points: Points, frame: CloudAxes) -> Transform:
    """Transform ``T_camera_input`` of a cloud in either frame: a scan is turned, and put on the optical axis.

    The network looks along lines of sight from the camera, but a scan does not say where the scanner stood; it is
    assumed ``VIEW_DISTANCE`` away, in front of the middle of the cloud. Raises ``ValueError`` for one without extent.
    """
    if frame == "camera":
        return np.eye(4)
    normalizer = Normalizer.fit(points)
    target = np.array([0.0, 0.0, VIEW_DISTANCE / normalizer.scale])
    return rigid(SCANNER_TO_CAMERA, target - SCANNER_TO_CAMERA @ normalizer.center)


def camera_axes(frame: CloudAxes) -> Transform:
    """Turn of a frame's axes into a camera's, about its own origin: for looking, where distance does not matter."""
    return rigid(SCANNER_TO_CAMERA if frame == "scanner" else np.eye(3), np.zeros(3))
