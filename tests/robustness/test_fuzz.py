"""Every reader with damaged files, headers that lie, and what unpacks to far more: taken, or refused in a sentence.

``MEREO_FUZZ_SEED`` draws other damage; the nightly tests spend ``MEREO_FUZZ_MINUTES`` (30) on as much as they allow.
"""

import gzip
import io
import json
import os
import resource
import struct
import time
import tracemalloc
from collections.abc import Callable
from itertools import islice
from math import inf
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import refusal
from fuzz import TARGETS, fault_of, inputs, limits, listing, zipped
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from PIL import Image
from safetensors import numpy as arrays
from safetensors.torch import load_file, save_file

from mereo import __main__ as command_line
from mereo.io.errors import LIMIT_VARIABLE, PAGES, max_bytes, quiet, reason, without_output, words_of
from mereo.io.intrinsics import read_intrinsics
from mereo.io.mesh_formats import read_glb, read_segmented_mesh
from mereo.io.readers import read_point_cloud, read_raw_depth
from mereo.io.sensor_frame import read_frame
from mereo.io.simulation_states import read_states
from mereo.io.volume_files import LabelVolume, Volume, read_label_volume, read_scalar_volume, segment_surfaces
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene

SEED = int(os.environ.get("MEREO_FUZZ_SEED", "0"))
MINUTES = float(os.environ.get("MEREO_FUZZ_MINUTES", "30"))
COUNT = {**dict.fromkeys(TARGETS, 10), "frames.vtu": 1, "frames.pvd": 1, "frames.xdmf": 1}
COUNT |= {"bar.yaml": 3, "left.stl": 3, "truth.json": 3, "weights.safetensors": 3}
"""Inputs of a kind in the fast test: fewer where one takes long."""


def check_kind(name: str, folder: Path, capfd: pytest.CaptureFixture, count: int, seed: int, end: float) -> None:
    for content, _, fault in islice(inputs(name, folder / "in", seed), count):
        if fault:
            (kept := folder / Path(name).name).write_bytes(content)
            pytest.fail(f"{fault}; the input is {kept}")
        if time.monotonic() > end:
            break
    printed = capfd.readouterr()
    assert printed.out + printed.err == "", "a reader prints nothing"


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_taken_or_refused(name: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    check_kind(name, tmp_path, capfd, COUNT[name], SEED, float("inf"))


@pytest.mark.nightly
@pytest.mark.parametrize("name", TARGETS)
def test_many_damaged_files(name: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    check_kind(name, tmp_path, capfd, 10**9, SEED + 1, time.monotonic() + 60 * MINUTES / len(TARGETS))


RECONSTRUCT = "reconstruct {} --weights tiny.safetensors --resolution 8 --output out"
COMMANDS = {
    **dict.fromkeys(("labelled.ply", "cloud.csv", "cloud.npz", "frames.db3"), RECONSTRUCT),
    "depth.png": f"{RECONSTRUCT} --intrinsics camera.json",
    "camera.json": f"{RECONSTRUCT.replace('{}', 'depth.png')} --intrinsics {{}}",
    "poses.csv": f"{RECONSTRUCT.replace('{}', 'cloud.npy')} --carry {{}}",
    "bar.yaml": "scene preview {} --output out.png",
    "start.json": "align cloud.npy --scene bar.yaml --start {} --output out",
    "manifest.json": "train . --preset tiny --epochs 1 --output out",
}


@pytest.mark.parametrize("name", [name for name in COMMANDS if name in TARGETS])
def test_what_a_reader_refuses_the_command_refuses(
    name: str, working_folder: Path, capfd: pytest.CaptureFixture
) -> None:
    """Exit code 2, one line, nothing written. Inputs that are taken are left out: their commands work."""
    for content, _, _ in islice((case for case in inputs(name, working_folder, SEED) if not case[1]), 3):
        for kind, file in (("weights.safetensors", "tiny.safetensors"), ("depth.png",) * 2, ("bar.yaml",) * 2):
            if not Path(file).exists():
                TARGETS[kind].write(working_folder / file)
        np.save("cloud.npy", default_rng(0).normal((0, 0, 20), 1, (200, 3)))
        (working_folder / name).write_bytes(content)
        before = listing(working_folder)
        capfd.readouterr()
        with limits():
            code = command_line.main(COMMANDS[name].format(name).split())
        printed = capfd.readouterr().err
        lines = [line for line in printed.splitlines() if not line.startswith("mereo: warning: ")]
        assert code == 2 and len(lines) == 1 and lines[0].startswith("mereo: error: "), (code, printed[:2000])
        assert lines[0].isprintable() and listing(working_folder) == before


# --- what damage once got through, as small as it can be, and what is said of it now ----------------------------------


def at(place: int, piece: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content[:place] + piece + content[place + len(piece) :]


def json_with(**values: object) -> Callable[[bytes], bytes]:
    return lambda content: json.dumps(json.loads(content) | values).encode()


def chunk_size(content: bytes) -> bytes:
    """The first chunk begins where the table of offsets says, and with its line and its size."""
    starts = (place for place in range(len(content) - 8) if struct.unpack_from("<Q", content, place)[0] == place + 8)
    return at(next(starts) + 12, struct.pack("<i", -1))(content)


def pair_at_infinity(content: bytes) -> bytes:
    """Finite as it is written, but not its products: LAPACK's decomposition of these never ended."""
    facts = json.loads(content)
    facts["object"]["scan"][3][0] = 1e308
    return json.dumps(facts).encode()


def complex_centres(content: bytes) -> bytes:
    """A shard without its checksum, whose numbers torch would make real with a warning."""
    tensors = arrays.load(content)
    return arrays.save({**tensors, "center": tensors["center"].astype(np.complex64)})


def labels_of_infinity(content: bytes) -> bytes:
    nibabel = pytest.importorskip("nibabel")
    return bytes(nibabel.Nifti1Image(np.full((4, 4, 4), inf, "f4"), np.eye(4)).to_bytes())


def signalling_depth(content: bytes) -> bytes:
    values = np.full((12, 16), 0.7, "<f4")
    values.view("<u4")[0, 0] = 0x7F800001
    Image.fromarray(values).save(file := io.BytesIO(), "TIFF")
    return file.getvalue()


CASES = {
    "pixels that OpenEXR prints about": ("depth.exr", chunk_size, "cannot be read as a depth image"),
    "a header of 4 GB": ("cloud.npy", at(6, b"\2\0" + b"\xff" * 4), "expected 4294967295 bytes"),
    "no array": ("surfaces.npz", lambda c: zipped({"a": b"text"}), "its entry 'a' is no array"),
    "a zero in YAML": ("bar.yaml", lambda c: c + b"\0", "this is not YAML in UTF-8 .unacceptable character"),
    "a number beyond all": ("bar.yaml", lambda c: c.replace(b"[120, 5", b"[1e308, 5", 1), "`pivot` is .* less than"),
    "a pose that no rotation fits": ("start.json", json_with(object=np.ones((4, 4)).tolist()), "start.json cannot"),
    "a point at infinity": ("start.json", pair_at_infinity, "scan of the start of the object must be rows of 3 finite"),
    "a camera of no size": (
        "frames.mcap",
        lambda c: c.replace(struct.pack("<d", 10.0), struct.pack("<d", np.nan)),
        "is no camera .focal",
    ),
    "complex places": ("shard-00000.safetensors", complex_centres, "its tensor 'center' has complex numbers"),
    "labels beyond all numbers": ("labels.nii", labels_of_infinity, "holds values that are no labels"),
    "a scan of two lines": ("truth.json", json_with(scan="\u2028"), r"the name of its scan is '.u2028'"),
    "an extension of 2 GB": ("labels.nii", at(352, struct.pack("<i", 2**31 - 16)), "labels.nii cannot be read"),
    "pixels that Pillow warned of": ("depth.tif", lambda c: c[:-7], "depth.tif cannot be read"),
    "a depth that signals": ("depth.tif", signalling_depth, None),
    "a normal that trimesh logged": ("text.stl", lambda c: c.replace(b"normal ", b"normal x", 1), None),
    "a header that nibabel changed": ("labels.nii", at(0, b"\0"), None),
}
"""Kind of file, its change, and the words of the refusal; None where it is taken, in silence."""


@pytest.mark.parametrize("case", CASES)
def test_it_is_one_sentence_now(case: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    name, change, expected = CASES[case]
    if name not in TARGETS:
        pytest.skip(f"nothing is installed that reads {name}")
    target = TARGETS[name]
    path = tmp_path / name
    target.write(path)
    path.write_bytes(change(path.read_bytes()))
    assert fault_of(target.read, path) == (expected is None, "")
    assert capfd.readouterr() == ("", "")
    if expected is not None:
        with pytest.raises(ValueError, match=expected):
            target.read(path)


def test_a_checkpoint_of_another_run_is_refused_before_training_begins(tmp_path: Path) -> None:
    target = TARGETS["checkpoint.safetensors"]
    path = tmp_path / "checkpoint.safetensors"
    target.write(path)
    whole = load_file(path)
    for name, size in (("optimizer/0/exp_avg", 7), ("optimizer/0", 1), ("network/x", 2)):
        save_file({**whole, name: torch.ones(size)}, path, metadata={"step": "3"})
        with pytest.raises(ValueError, match=r"checkpoint.safetensors cannot be read \(.*\); delete it to train"):
            target.read(path)


def test_a_librarys_text_is_short_and_its_output_is_dropped(capfd: pytest.CaptureFixture) -> None:
    error = ValueError("the segment \x1b[31mred\x07 is unknown;\n\u2028correct it")
    assert words_of(error) == r"the segment \x1b[31mred\x07 is unknown; correct it"
    assert len(reason(ValueError("a" * 5000))) == 303
    with without_output():
        print("text")
        os.write(2, b"text")
    assert capfd.readouterr() == ("", "")
    with quiet():
        assert np.float64(1e308) * 10 == inf


# --- headers that lie, and files that unpack to far more than they are ------------------------------------------------


POINTS = default_rng(0).normal(size=(57, 3)).astype(np.float32)


def nifti(*sizes: int) -> bytes:
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.uint8)
    header["dim"], header["vox_offset"], header["magic"] = (3, *sizes, 1, 1, 1, 1), 352, b"n+1"
    return bytes(header.binaryblock) + bytes(214)


def nrrd(sizes: str, encoding: str, data: bytes) -> bytes:
    pytest.importorskip("nrrd", reason="pynrrd is not installed: pip install 'mereo[medical]'")
    return f"NRRD0004\ntype: uchar\ndimension: 3\nsizes: {sizes}\nencoding: {encoding}\n\n".encode() + data


def test_a_volume_whose_header_lies_is_refused(tmp_path: Path) -> None:
    huge = "takes more than 8 GB of memory to read|cannot be read as a label volume"
    for name, content, sentence in (
        ("a.nii.gz", gzip.compress(nifti(32000, 32000, 30)), huge),
        ("b.nii", nifti(-5, 6, 7), "its header states the size -5 x 6 x 7"),
        ("a.nrrd", nrrd("32000 32000 30", "raw", bytes(210)), huge),
        ("b.nrrd", nrrd("-5 -6 7", "raw", bytes(210)), "the size -5 x -6 x 7"),
    ):
        (tmp_path / name).write_bytes(content)
        with refusal(f"{name}.*({sentence})"):
            read_label_volume(tmp_path / name)


@pytest.mark.parametrize("read", [read_label_volume, read_scalar_volume])
def test_a_volume_is_refused_by_its_header_and_takes_a_few_bytes_a_voxel(
    read: Callable[[Path], Volume | LabelVolume], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The voxels of the first file are not there: they were never looked for."""
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(nifti(2200, 2200, 2200)))
    (tmp_path / "a.nrrd").write_bytes(nrrd("2200 2200 2200", "gzip", b"none"))
    for name in ("a.nii.gz", "a.nrrd"):
        with pytest.raises(ValueError, match=rf"{name} takes more than 8 GB of memory to read: check that it is what"):
            read(tmp_path / name)
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(nifti(200, 200, 200) + bytes(200**3), 1))
    tracemalloc.start()
    assert not np.any(read(tmp_path / "b.nii.gz").values)
    assert tracemalloc.get_traced_memory()[1] < 3.5 * 200**3
    tracemalloc.stop()
    volume = LabelVolume(np.ones((1, 60, 60, 60), np.uint8), np.eye(4), {})
    monkeypatch.setenv(LIMIT_VARIABLE, "0.0005")
    with pytest.raises(ValueError, match=r"the label volume takes more than 0\.0005 GB of memory to read"):
        segment_surfaces(volume, {1: "a"}, 16)


def test_a_volume_opens_no_file_outside_its_folder_and_none_that_is_no_file(tmp_path: Path) -> None:
    (folder := tmp_path / "ct").mkdir()
    (folder / "sub").mkdir()
    for place in (folder / "sub/a.raw", tmp_path / "a.raw"):
        place.write_bytes(bytes(32) + bytes([2]) * 32)
    os.mkfifo(folder / "pipe")
    (folder / "link.raw").symlink_to(tmp_path / "a.raw")
    for name in ("sub/a.raw", "../a.raw", str(tmp_path / "a.raw"), "pipe", "link.raw", "none.raw", "sub"):
        for key in ("data file", "datafile"):
            (folder / "a.nrrd").write_bytes(nrrd(f"4 4 4\n{key}: {name}", "raw", b""))
            if name == "sub/a.raw":
                assert read_label_volume(folder / "a.nrrd").values == (2,)
                continue
            with pytest.raises(ValueError, match=rf"\(its data file '{name}' is not a regular file in its folder or"):
                read_label_volume(folder / "a.nrrd")


@pytest.mark.parametrize("axis", [np.nan, inf, 0.0])
def test_a_volume_whose_axes_do_not_span_space_is_refused(axis: float, tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    header = nibabel.Nifti1Header.from_fileobj(io.BytesIO(nifti(4, 4, 4)))
    header["sform_code"], header["srow_x"], header["srow_y"] = 1, [1, 0, 0, 0], [0, 1, 0, 0]
    header["srow_z"] = [0, 0, axis, 0]
    (tmp_path / "a.nii").write_bytes(bytes(header.binaryblock) + bytes(4) + bytes([1]) * 64)
    with pytest.raises(ValueError, match=r"a.nii has voxels whose axes are \[\[.*\]\]; they must span space: export"):
        read_label_volume(tmp_path / "a.nii")


BOMBS = {"a.npz": read_point_cloud, "a.nrrd": read_label_volume}
"""Files of about a megabyte that unpack to one gigabyte."""


@pytest.mark.skipif(not PAGES.exists(), reason="only Linux holds a process to a limit")
@pytest.mark.parametrize("name", BOMBS)
def test_what_takes_too_much_memory_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / name
    if name == "a.npz":
        np.savez_compressed(path, points=np.zeros((83_333_333, 3), "f4"))
    else:
        path.write_bytes(nrrd("1000 1000 1000", "gzip", gzip.compress(bytes(1_000_000_000), 1)))
    before = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setenv(LIMIT_VARIABLE, "0.7")
    with pytest.raises(ValueError, match=r"takes more than 0\.7 GB of memory to read") as caught:
        BOMBS[name](path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_a_pipe_or_device_that_is_named_like_a_file_is_refused_at_once(tmp_path: Path) -> None:
    """Nobody writes to this pipe: whoever opened it would wait for ever."""
    readers = {
        ".ply": read_frame,
        ".npy": read_frame,
        ".bag": read_frame,
        ".obj": read_segmented_mesh,
        ".glb": read_glb,
        ".png": read_raw_depth,
        ".nrrd": read_label_volume,
        ".json": read_intrinsics,
        ".npz": lambda p: read_states(p, ("a",)),
        ".yaml": load_scene,
        ".safetensors": lambda p: load_model(str(p)),
    }
    for suffix, read in readers.items():
        os.mkfifo(path := tmp_path / f"a{suffix}")
        with pytest.raises((ValueError, FileNotFoundError), match=f"a{suffix}"):
            read(path)


def test_the_limit_is_a_positive_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    for text in ("much", "-1", "0", "nan", "inf"):
        monkeypatch.setenv(LIMIT_VARIABLE, text)
        with pytest.raises(ValueError, match=f"^MEREO_MAX_FILE_GB is '{text}'; it must be a positive number of"):
            read_point_cloud(tmp_path / "a.npy")
    monkeypatch.setenv(LIMIT_VARIABLE, "12.5")
    assert max_bytes() == 12.5e9 and len(read_point_cloud(tmp_path / "a.npy").points) == 57


def test_no_flipped_bit_of_a_png_makes_another_image(tmp_path: Path) -> None:
    """Pillow alone returns other depths for some of them."""
    values = default_rng(0).integers(500, 900, (8, 8)).astype(np.uint16)
    path = tmp_path / "a.png"
    Image.fromarray(values).save(path)
    whole = path.read_bytes()
    for place in range(8, len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        try:
            found = read_raw_depth(path)
        except ValueError:
            continue
        assert_array_equal(found, values)
