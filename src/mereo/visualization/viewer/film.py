"""Films of the laboratory: one picture for each moment that it shows, as an animated GIF.

The pictures are our own renderer's, so that they need no browser's answer. An MP4 would need an encoder, and none of
our dependencies brings one.
"""

import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import look_at
from mereo.visualization.renderer import Canvas, Viewpoint, draw_mesh

SIZE = (480, 360)
"""Width and height in pixels."""

MOST_FRAMES = 240
FRAME_MS = 80
"""Time that a picture is shown; the longest film takes 19 s."""

MOST_BYTES = 16 * 2**20
"""Size above which every second picture is left out, again and again."""

COLORS = 128
INSET = 0.3
"""Share of the height that the depth image takes, in a corner."""

POINT_COLOR = (0.12, 0.14, 0.18)


def viewpoint(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"], fov_rad: float
) -> Viewpoint:
    """Viewpoint of a browser's camera, whose field of view is the vertical one."""
    width, height = SIZE
    focal = height / (2 * np.tan(fov_rad / 2))
    return Viewpoint.through(Camera(width, height, focal, focal, width / 2, height / 2), look_at(position, target, up))


def picture(
    view: Viewpoint,
    meshes: list[SegmentedMesh],
    points: Float[np.ndarray, "n 3"],
    depth: UInt8[np.ndarray, "r c 3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Picture of a moment.

    Args:
        view: from where.
        meshes: what is shown, on the stage.
        points: what the camera sees, on the stage; may be none.
        depth: picture of the depth image.
    """
    canvas = Canvas.empty(view, SIZE)
    for mesh in meshes:
        draw_mesh(canvas, mesh)
    canvas.draw_points(points, np.tile(POINT_COLOR, (len(points), 1)), 0.8)
    result = canvas.picture()
    side = round(INSET * SIZE[1])
    corner = Image.fromarray(depth).resize((side, side), Image.Resampling.NEAREST)
    result[-side:, :side] = np.asarray(corner)
    return result


class Film:
    """Pictures of one size, one after another; ``MOST_FRAMES`` at most, later ones are not taken."""

    def __init__(self, view: Viewpoint) -> None:
        self.view = view
        self._frames: list[Image.Image] = []

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def is_full(self) -> bool:
        """Whether no more pictures are taken."""
        return len(self._frames) >= MOST_FRAMES

    def add(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Take a picture, in ``COLORS`` colours of its own, as a GIF has them."""
        if not self.is_full:
            self._frames.append(Image.fromarray(frame).quantize(COLORS, dither=Image.Dither.NONE))

    def gif(self) -> bytes:
        """The film, without end; of at most ``MOST_BYTES``. Raises ``ValueError`` where there is no picture."""
        if not self._frames:
            raise ValueError("nothing has moved while it was recorded: move a slider or walk, then stop")
        step = 1
        while len(content := self._encoded(step)) > MOST_BYTES and step < len(self._frames):
            step *= 2
        return content

    def _encoded(self, step: int) -> bytes:
        first, *others = self._frames[::step]
        content = io.BytesIO()
        first.save(content, "GIF", save_all=True, append_images=others, duration=step * FRAME_MS, loop=0)
        return content.getvalue()
