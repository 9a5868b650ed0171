"""Depth images: every format gives metres, and a bad one gets one sentence."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mereo.geometry.camera import Camera
from mereo.io.readers import is_depth_image, read_depth_image, read_mask

CAMERA = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)


def assert_sentence(error: Exception, path: Path) -> None:
    """One line that names the file and, after a colon, the cure."""
    message = str(error)
    assert "\n" not in message and str(path) in message and ": " in message.replace(str(path), "")


def save_depth(path: Path, values: np.ndarray) -> Path:
    Image.fromarray(values).save(path)
    return path


def test_depth_is_value_over_scale_and_masked(tmp_path: Path) -> None:
    values = np.random.default_rng(1).integers(400, 60000, (6, 8)).astype(np.uint16)
    values[2, 3] = 0
    path = save_depth(tmp_path / "d.png", values)
    np.testing.assert_array_equal(read_depth_image(path, CAMERA, 5000.0).depth, values / 5000.0)
    mask = np.zeros((6, 8), np.uint8)
    mask[1:4, 2:5] = 255
    masked = read_depth_image(path, CAMERA, 5000.0, save_depth(tmp_path / "m.png", mask))
    assert int(masked.valid.sum()) == 8
    np.testing.assert_array_equal(masked.depth, np.where(mask > 0, values / 5000.0, 0))


def test_a_bad_depth_image_gets_one_sentence(tmp_path: Path) -> None:
    good = np.full((6, 8), 900, np.uint16)
    path = tmp_path / "d.png"
    for values, scale, expected in (
        (np.zeros((6, 8), np.uint16), 1000.0, "measures 0 pixels in the image"),
        (np.full((6, 8), 90, np.uint8), 1000.0, "mode L, not a 16-bit grey PNG"),
        (np.full((6, 9), 900, np.uint16), 1000.0, "9 x 6 pixels but the intrinsics say 8 x 6"),
        (good, 1.0, "median depth of .* is 900 m.*--depth-scale"),
        (good, 0.0, "depth scale is 0.0"),
    ):
        save_depth(path, values)
        with pytest.raises(ValueError, match=expected) as caught:
            read_depth_image(path, CAMERA, scale)
        assert "\n" not in str(caught.value)
    noise = np.random.default_rng(0).integers(500, 1500, (60, 80)).astype(np.uint16)
    path.write_bytes(save_depth(path, noise).read_bytes()[:3000])
    with pytest.raises(ValueError, match="cannot be read as a depth image") as caught:
        read_depth_image(path, CAMERA)
    assert_sentence(caught.value, path)
    save_depth(path, good)
    with pytest.raises(ValueError, match="measures 0 pixels inside the mask"):
        read_depth_image(path, CAMERA, 1000.0, save_depth(tmp_path / "m.png", np.zeros((6, 8), np.uint8)))
    with pytest.raises(ValueError, match="the mask .* is 5 x 4 pixels but the depth image is 8 x 6"):
        read_depth_image(path, CAMERA, 1000.0, save_depth(tmp_path / "m.png", np.ones((4, 5), np.uint8)))


def test_masks_of_all_kinds_agree(tmp_path: Path) -> None:
    truth = np.random.default_rng(2).random((5, 7)) > 0.5
    grey = Image.fromarray(truth.astype(np.uint8) * 9)
    for name, image in (
        ("grey", grey),
        ("deep", Image.fromarray(truth.astype(np.uint16) * 256)),
        ("bits", Image.fromarray(truth)),
        ("color", Image.merge("RGB", (Image.new("L", grey.size), grey, Image.new("L", grey.size)))),
        ("opaque", Image.merge("RGBA", (grey, grey, grey, Image.new("L", grey.size, 255)))),
    ):
        image.save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(read_mask(tmp_path / f"{name}.png"), truth, err_msg=name)


MILLIMETRES = np.random.default_rng(5).integers(400, 9000, (6, 8)).astype(np.uint16)
MILLIMETRES[2, 3] = 0
METRES = np.where(MILLIMETRES > 0, MILLIMETRES / np.float32(1000), np.nan).astype(np.float32)


def save_big_endian_tiff(path: Path) -> None:
    """One strip of 16-bit grey, most significant byte first: Pillow writes the other order only."""
    tags = [(256, 8), (257, 6), (258, 16), (259, 1), (262, 1), (273, 8), (277, 1), (278, 6), (279, 96)]
    entries = b"".join(np.array([tag, 3, 0, 1, value, 0], ">u2").tobytes() for tag, value in tags)
    start = (8 + 96).to_bytes(4, "big")
    head = b"MM\x00\x2a" + start + MILLIMETRES.astype(">u2").tobytes()
    path.write_bytes(head + len(tags).to_bytes(2, "big") + entries + bytes(4))


@pytest.mark.parametrize("name", ["short.tif", "float.tiff", "big.tif", "short.npy", "float.npy", "double.npy"])
def test_every_format_gives_the_same_metres(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "big.tif":
        save_big_endian_tiff(path)
    elif path.suffix == ".npy":
        np.save(path, {"short": MILLIMETRES, "float": METRES, "double": METRES.astype(">f8")}[path.stem])
    else:
        Image.fromarray(MILLIMETRES if path.stem == "short" else METRES).save(path, compression="tiff_lzw")
    depth = read_depth_image(path, CAMERA).depth
    np.testing.assert_allclose(depth, MILLIMETRES / 1000, rtol=1e-6)
    assert depth[2, 3] == 0, "NaN and 0 both say that nothing was measured"


@pytest.mark.parametrize(
    "channels", [{"Z": 1.0}, {"ViewLayer.Depth.Z": 1.0, "R": 9.0, "G": 9.0, "B": 9.0}, {"odd": 1.0}]
)
def test_exr(tmp_path: Path, channels: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR comes with the extra sensors")
    stored = np.where(np.isnan(METRES), np.float32(1e10), METRES)  # what renderers write where there is nothing
    pixels = {name: np.ascontiguousarray(stored * np.float32(factor)) for name, factor in channels.items()}
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, pixels).write(str(tmp_path / "d.exr"))
    np.testing.assert_allclose(read_depth_image(tmp_path / "d.exr", CAMERA).depth, MILLIMETRES / 1000, rtol=1e-6)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"d.exr needs OpenEXR, .*: pip install 'mereo\[sensors\]'"):
        read_depth_image(tmp_path / "d.exr", CAMERA)


def test_what_is_no_depth_image_is_said_so(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((6, 8), np.uint8)).save(tmp_path / "grey.tif")
    pages = [Image.fromarray(MILLIMETRES)] * 2
    pages[0].save(tmp_path / "pages.tif", save_all=True, append_images=pages[1:])
    np.save(tmp_path / "words.npy", np.array([["a", "b"]]))
    (tmp_path / "photo.jpg").write_bytes(b"JFIF")
    for name, expected in (
        ("grey.tif", "mode L, not a grey TIFF of 16-bit or float values"),
        ("pages.tif", "2 pages instead of one"),
        ("words.npy", "not a number"),
        ("photo.jpg", "suffix '.jpg'; a depth image is one of .png, .tif, .tiff, .exr, .npy"),
    ):
        with pytest.raises(ValueError, match=expected) as caught:
            read_depth_image(tmp_path / name, CAMERA)
        assert_sentence(caught.value, tmp_path / name)


def test_arrays_are_told_apart_by_their_shape(tmp_path: Path) -> None:
    cases = (((48, 64), True), ((100, 3), False), ((100, 2), False), ((100, 6), False), ((48, 64, 3), False))
    for shape, image in cases:
        np.save(tmp_path / "a.npy", np.ones(shape))
        assert is_depth_image(tmp_path / "a.npy") == image
