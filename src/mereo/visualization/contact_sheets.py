"""Contact sheets, captions, legends, and depth as colour: what all pictures are put together from."""

import base64
import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from mereo.geometry.brief import rounded
from mereo.geometry.camera import DepthImage, Size
from mereo.geometry.conventions import Range
from mereo.geometry.mesh import Color
from mereo.geometry.transforms import Points
from mereo.io.atomic_files import JsonObject, atomic_file
from mereo.io.errors import AnyPath
from mereo.visualization.color_scales import viridis
from mereo.visualization.renderer import Canvas, Viewpoint
from mereo.visualization.units import Unit

Picture = UInt8[np.ndarray, "_ _ 3"]
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

INK: Color = (28, 32, 38)
MISSING: Color = (236, 237, 240)

MOST_DEPTH_PX = 480
"""Longer side of a page's depth image at most; larger ones are thinned, pixel by pixel."""

PNG_URL = "data:image/png;base64,"


def save_png(path: AnyPath, picture: Picture) -> None:
    """Write a picture whole or not at all."""
    with atomic_file(Path(path)) as partial:
        Image.fromarray(picture).save(partial, format="PNG")


def contact_sheet(
    images: Sequence[Picture], captions: Sequence[str], columns: int, title: str = "", gap: int = 12
) -> Picture:
    """Sheet of images in rows of ``columns`` on white, each with its caption below, ``title`` above all.

    Raises ``ValueError`` when there are no images, or not as many captions.
    """
    if not images or len(images) != len(captions) or columns < 1:
        raise ValueError(
            f"{len(images)} images, {len(captions)} captions, {columns} columns; one caption for each image"
        )
    cell_w, cell_h = max(i.shape[1] for i in images), max(i.shape[0] for i in images)
    text_h = 24 if any(captions) else 0
    top = gap + (36 if title else 0)
    rows = -(-len(images) // columns)
    size = (gap + columns * (cell_w + gap), top + rows * (cell_h + text_h + gap))
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    if title:
        pen.text((gap, gap), title, fill=INK, font=fit_font(20, title, size[0] - 2 * gap))
    for index, (image, caption) in enumerate(zip(images, captions, strict=True)):
        x = gap + index % columns * (cell_w + gap)
        y = top + index // columns * (cell_h + text_h + gap)
        sheet.paste(Image.fromarray(image), (x + (cell_w - image.shape[1]) // 2, y + (cell_h - image.shape[0]) // 2))
        anchor = (x + cell_w // 2, y + cell_h + text_h // 2)
        pen.text(anchor, caption, fill=INK, font=fit_font(14, caption, cell_w), anchor="mm")
    return np.asarray(sheet)


def fit_font(size: int, text: str, width: int) -> Font:
    """Font of Pillow's own, small enough for ``text`` to fit into ``width`` pixels."""
    while size > 8 and font(size).getlength(text) > width:
        size -= 1
    return font(size)


@cache
def font(size: int) -> Font:
    """Font of Pillow's own in a size; unpacking it takes longer than drawing with it."""
    return ImageFont.load_default(size)


def depth_to_rgb(image: DepthImage, limits: Range | None = None) -> Picture:
    """Depth as colour (viridis, near is bright); pale grey where nothing was measured.

    ``limits`` is the nearest and farthest depth shown; by default the range of what was measured.
    """
    seen = image.depth[image.valid]
    near, far = limits or ((float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0))
    nearness = 1 - (image.depth - near) / max(far - near, 1e-12)
    return np.where(image.valid[..., None], viridis(nearness), np.asarray(MISSING, np.uint8))


def enlarge(picture: Picture, width: int) -> Picture:
    """Picture enlarged to a width, pixel by pixel, without interpolation."""
    return np.asarray(Image.fromarray(picture).resize((width, width * picture.shape[0] // picture.shape[1]), 0))


def depth_picture(depth: DepthImage) -> Picture:
    """Picture of what was measured, and a little around it, near is bright, of ``MOST_DEPTH_PX`` pixels at most."""
    rows, columns = (np.flatnonzero(depth.valid.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows, columns = np.arange(depth.depth.shape[0]), np.arange(depth.depth.shape[1])
    margin = 1 + int(0.08 * max(np.ptp(rows), np.ptp(columns)))
    window = tuple(slice(max(int(part[0]) - margin, 0), int(part[-1]) + 1 + margin) for part in (rows, columns))
    shown = depth_to_rgb(depth)[window]
    step = -(-max(shown.shape) // MOST_DEPTH_PX)
    return np.ascontiguousarray(shown[::step, ::step])


def depth_ends(depth: DepthImage, unit: Unit) -> list[str]:
    """Nearest and farthest depth in words; of an image without measurements none."""
    measured = depth.depth[depth.valid]
    ends = (float(measured.min()), float(measured.max())) if len(measured) else ()
    return [f"{rounded(end * unit.length_factor)} {unit.length_name}" for end in ends]


def depth_data(depth: DepthImage, unit: Unit) -> JsonObject:
    """What a page needs to show a depth image: ``url``, ``width`` and ``height`` of its picture, ``ends`` in words."""
    picture = depth_picture(depth)
    height, width = picture.shape[:2]
    return {"url": data_url(picture), "width": width, "height": height, "ends": depth_ends(depth, unit)}


def data_url(picture: Picture) -> str:
    """Picture as an address that holds it; its 96 colours make it a quarter as large."""
    content = io.BytesIO()
    Image.fromarray(picture).quantize(96, dither=Image.Dither.NONE).save(content, format="PNG", optimize=True)
    return PNG_URL + base64.b64encode(content.getvalue()).decode("ascii")


def cloud_picture(points: Points, view: Viewpoint, size: Size) -> Picture:
    """Picture of a point cloud coloured by depth, near is bright, on white."""
    canvas = Canvas.empty(view, size)
    if len(points):
        z = view.apply(points)[:, 2]
        nearness = 1 - (z - z.min()) / max(float(np.ptp(z)), 1e-12)
        canvas.draw_points(points, viridis(0.05 + 0.85 * nearness) / 255, 1.5)
    return canvas.picture()


def legend(names: Sequence[str], colors: Sequence[Color], width: int) -> Picture:
    """Strip with a swatch and a name for each segment, in as many rows as are needed."""
    corners = []
    x = 12
    y = 6
    for name in names:
        length = 22 + int(font(15).getlength(name)) + 20
        if x > 12 and x + length > width:
            x = 12
            y = y + 26
        corners.append((x, y))
        x += length
    strip = Image.new("RGB", (width, y + 30), "white")
    pen = ImageDraw.Draw(strip)
    for name, color, (left, top) in zip(names, colors, corners, strict=True):
        pen.rounded_rectangle((left, top + 2, left + 15, top + 17), 4, fill=color)
        pen.text((left + 22, top + 10), name, fill=INK, font=font(15), anchor="lm")
    return np.asarray(strip)
