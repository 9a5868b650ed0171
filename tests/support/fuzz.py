"""Damaged files of every kind that mereo reads, and the rule that holds for each.

An input is taken, or refused with one line that names it (exit code 2), soon, in little memory and silently; nothing is
written. ``TARGETS`` are small valid files, with what writes and reads them, those whose library is missing left out.
``damaged`` draws damage from a ``Random``, so that a seed gives the same on every machine.
"""

import copy
import faulthandler
import gzip
import io
import json
import math
import os
import re
import resource
import signal
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
import registered_states
import torch
import trimesh
import yaml
from camera_files import write_camera
from lattice import pvd_text, xdmf_text
from numpy import ndarray
from numpy.random import default_rng
from PIL import Image
from point_files import save_pcd, save_ply
from robot_files import LAPTOP, LAPTOP_SDF
from scene_code import EVERYTHING
from scene_files import write_bar
from shapes import ball
from toy_data import write_toy_dataset
from toy_scene import toy_scene
from written_results import COLORS, cloud, grid, segments

from mereo.geometry.camera import Camera
from mereo.geometry.conventions import Pair
from mereo.io.atomic_files import check_new_directory, new_directory, write_json
from mereo.io.attachments import read_attachments, read_pose_table
from mereo.io.config import InputConfig
from mereo.io.errors import LIMIT_VARIABLE, is_foreseen, words_of
from mereo.io.intrinsics import read_intrinsics
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import read_mask, read_point_cloud
from mereo.io.sensor_frame import message_frame, read_frame, read_messages
from mereo.io.simulation_states import read_states
from mereo.io.volume_files import read_label_volume
from mereo.io.writers.glb import write_segments_glb
from mereo.io.writers.meshes import write_points_ply, write_segments_obj, write_segments_ply
from mereo.io.writers.volumes import write_labels_nifti, write_labels_seg_nrrd
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import load_model, save_model
from mereo.results.state import load_state, save_state, state_of
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import StatisticalModel, load_statistical_model, save_statistical_model
from mereo.synthesis.sample_views import SHIPPED, load_view
from mereo_learning.config import PRESETS
from mereo_learning.dataset import Dataset
from mereo_learning.model_card import card
from mereo_learning.placement import PlacedSegment, Placement, read_start
from mereo_learning.processes import Process
from mereo_learning.run_directory import Checkpoint, claim_run, fit_config, load_checkpoint, save_checkpoint
from mereo_learning.scans import ScanFile, read_truth, write_truth
from mereo_learning.tables import read_metrics

# --- the rule ---------------------------------------------------------------------------------------------------------


class TooSlow(BaseException):
    """Signal that the time is over; no ``except Exception`` holds it up."""


@contextmanager
def limits(seconds: float = 60.0, gigabytes: float = 2.0) -> Iterator[None]:
    """Let a block have so much time and so much more memory than there is now; after thrice the time all ends."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooSlow

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if (pages := Path("/proc/self/statm")).exists():
        now = int(pages.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + int(gigabytes * 1e9), hard))
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(3 * seconds, exit=True)  # where a library holds up the signal for ever
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def fault_of(read: Callable[[Path], object], path: Path) -> tuple[bool, str]:
    """Whether an input was taken, and how that broke the rule; a refusal may name the folder of the input instead."""
    error = None
    before = listing(path.parent)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        os.environ[LIMIT_VARIABLE] = "1"  # the default alone is more than the rule allows
        try:
            with limits():
                read(path)
        except (Exception, TooSlow, SystemExit) as caught:
            error = caught
        finally:
            del os.environ[LIMIT_VARIABLE]
    unseen = (DeprecationWarning, PendingDeprecationWarning, ResourceWarning, ImportWarning)
    strange = [w for w in warned if not (issubclass(w.category, unseen) or w.category.__module__.startswith("mereo"))]
    words = words_of(error) if isinstance(error, Exception) else repr(error)
    names = (path.name, path.parent.name, path.parents[1].name)
    faults = {
        "it is not foreseen": error is not None and not (isinstance(error, Exception) and is_foreseen(error)),
        "it has several lines": len(str(error).splitlines()) > 1,
        "a terminal obeys it": not words.replace("\u00a0", " ").isprintable(),
        "it names no file": error is not None and not any(name in words for name in names),
        "it is too long": len(words) > 3000,
        f"a library warns {[str(w.message) for w in strange]}": bool(strange),
        "something is written": listing(path.parent) != before,
    }
    broken = [text for text, is_so in faults.items() if is_so]
    return error is None, f"{'; '.join(broken)}: {error!r}" if broken else ""


def listing(folder: Path) -> dict[str, Pair]:
    """Files of a folder, with what changes when they do."""
    found = {str(path.relative_to(folder)): path.stat() for path in folder.rglob("*")}
    return {name: (stat.st_size, stat.st_mtime_ns) for name, stat in found.items()}


# --- damage -----------------------------------------------------------------------------------------------------------

PIECES = (
    *(b"", b"\0", b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", struct.pack("<f", math.nan), b"\xff" * 8),
    *(struct.pack("<d", 1e300), struct.pack("<q", 1 << 40), struct.pack(">I", 1 << 30), b"-1", b"0", b"4294967295"),
    *(b"1" + b"0" * 40, b"1e999", b"nan", b"0x10", b"1,5", b"\n", b"\xef\xbb\xbf", b"\x1b[31m", b'"', b"{", b"]", b":"),
    *(b"&a", b"*a", b"!!binary ", b"../..", b"\xed\xa0\x80", "\u2028".encode(), b"%s", b"null", b"#", b","),
)
VALUES = (
    *(None, True, 0, -1, 255, 2**31, 2**63, 10**30, 0.5, 1e308, math.nan, math.inf, "", "a", "\n", "\x1b[31m"),
    *("\ud800", "../..", "a" * 5000, [], {}, [[]], [None], [0] * 4, [1e308] * 3, {"a": 1}, {"": None}),
    list(range(300)),
)


def damaged(content: bytes, rng: Random) -> bytes:
    """Content after one to four changes, inside of what is packed or has checksums where it is known how."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        try:
            content = _inside(content, rng) if rng.random() < 0.6 else _bytes(content, rng)
        except (ValueError, EOFError, OSError, LookupError, RuntimeError, TypeError, AttributeError, zlib.error,
                struct.error, zipfile.BadZipFile, yaml.YAMLError):  # fmt: skip
            content = _bytes(content, rng)  # damaged before, or of no such kind
    return content


def _bytes(content: bytes, rng: Random) -> bytes:
    """A piece, number or word doubled, flipped, odd or gone, or an end; beginnings as often as all the rest."""
    way = rng.choice(("number", "word", "end", "twice", "flip", "odd", "odd", "gone", "new"))
    pattern = {"number": rb"-?\d+(\.\d+)?", "word": rb"[A-Za-z_]+"}.get(way)
    spans = [match.span() for match in re.finditer(pattern, content[:65536])] if pattern else []
    start = rng.randrange(1 + min(len(content), rng.choice((512, len(content)))))
    start, end = rng.choice(spans[: rng.choice((40, 9999))]) if spans else (start, start + rng.randrange(1, 64))
    piece = content[start:end]
    odd = rng.choice((*PIECES, rng.randbytes(8)))
    if way in ("end", "new"):
        return content[:start] + (odd + content[start:] if way == "new" else b"")
    if way == "odd":
        end = start + len(odd)
    flipped = bytes([piece[0] ^ 1 << rng.randrange(8)]) + piece[1:] if piece else b""
    new = {"twice": piece * rng.choice((2, 50)), "flip": flipped, "gone": b""}.get(way, odd)
    return content[:start] + new + content[end:]


def _inside(content: bytes, rng: Random) -> bytes:
    if content.startswith(b"PK\3\4"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {item.filename: archive.read(item) for item in archive.infolist()}
        name = rng.choice(list(members))
        members[name] = damaged(members[name], rng)
        return zipped({rng.choice((f"a{name}", name, name, name)): members.pop(name), **members})
    if content.startswith(b"\x1f\x8b"):
        return gzip.compress(damaged(gzip.decompress(content), rng), mtime=0)
    if content.startswith(b"\x89PNG"):
        chunks = list[tuple[bytes, bytes]]()
        at = 8
        while at < len(content):
            end = at + 8 + int.from_bytes(content[at : at + 4], "big")
            chunks.append((content[at + 4 : at + 8], content[at + 8 : end]))
            at = end + 4
        index = rng.randrange(len(chunks))
        kind, data = chunks[index]
        inner = zlib.compress(damaged(zlib.decompress(data), rng)) if kind == b"IDAT" else damaged(data, rng)
        chunks[index : index + 1] = rng.choice(([(kind, inner)],) * 5 + ([], [(kind, data)] * 2))
        packed = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
        return content[:8] + b"".join(packed)
    if content.startswith(b"glTF"):
        end = 20 + int.from_bytes(content[12:16], "little")
        text = json.dumps(_changed(json.loads(content[20:end]), rng)).encode()
        rest = content[end:]
        text += b" " * (-len(text) % 4)
        return b"glTF" + struct.pack("<IIII", 2, 20 + len(text + rest), len(text), 0x4E4F534A) + text + rest
    if content[8:9] == b"{":  # safetensors
        end = 8 + int.from_bytes(content[:8], "little")
        text = json.dumps(_changed(json.loads(content[8:end]), rng)).encode()
        return struct.pack("<Q", len(text)) + text + content[end:]
    if content[:1] in (b"{", b"["):
        return json.dumps(_changed(json.loads(content), rng)).encode()
    document = yaml.safe_load(content)
    if not isinstance(document, dict):
        raise ValueError("no document")
    return yaml.safe_dump(_changed(document, rng)).encode()


def zipped(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def _changed(tree: Any, rng: Random) -> Any:
    """Tree of JSON or YAML with one value odd, in a list, gone or of another place; texts may be JSON themselves."""
    whole = {"": copy.deepcopy(tree)}
    spots = list[tuple[Any, Any]]([(whole, "")])
    for box, key in spots:  # which grow
        value = box[key]
        keys = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        spots += [(value, name) for name in keys]
    (box, key), (other, name) = rng.choice(spots), rng.choice(spots)
    if isinstance(box[key], str) and box[key].startswith("{"):
        box[key] = json.dumps(_changed(json.loads(box[key]), rng))
    elif box is not whole and rng.random() < 0.1:
        del box[key]
    else:
        box[key] = rng.choice((*VALUES, *([box[key]], copy.deepcopy(other[name])) * 2))
    return whole[""]


# --- small valid files ------------------------------------------------------------------------------------------------

POINTS = default_rng(0).normal((0, 0, 2), 0.2, (40, 3)).round(3)
DEPTH = default_rng(0).integers(500, 900, (12, 16)).astype(np.uint16)
CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
NODES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FRAMES = np.stack([NODES, NODES * 1.1, NODES + 1])
ELEMENTS = np.array([[0, 1, 2, 3]])
ROS_YAML = """\
image_width: 16
image_height: 12
camera_matrix: {rows: 3, cols: 3, data: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
PCD = ("ascii", "binary", "binary_compressed")
BOP = {str(i): {"cam_K": [20, 0, 8, 0, 20, 6, 0, 0, 1], "depth_scale": 0.1} for i in (1, 2)}
Write = Callable[[Path], object]


def text(content: str) -> Write:
    return lambda path: path.write_text(content, encoding="utf-8")


def rows(mark: str, head: str) -> Write:
    return text(head + "".join(mark.join(map(str, row)) + "\n" for row in POINTS.tolist()))


def write_cloud(save: Callable[[ndarray, str], bytes], layout: str, path: Path) -> None:
    path.write_bytes(save(POINTS.astype(np.float32), layout))


def image(values: ndarray, **options: Any) -> Write:
    def write(path: Path) -> None:
        write_camera(path.with_name("camera.json"), CAMERA)
        if path.suffix == ".npy":
            np.save(path, values)
        elif path.suffix == ".exr":
            import OpenEXR

            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"Z": values}) as file:
                file.write(str(path))
        else:
            Image.fromarray(values).save(path, **options)

    return write


def vtk(path: Path) -> None:
    """A tetrahedron in VTK's formats, or one that names others of three frames."""
    import pyvista

    one = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: ELEMENTS}, NODES)
    one.point_data["u"] = FRAMES[1] - NODES
    if path.suffix == ".xdmf":
        path.write_text(xdmf_text(NODES, ELEMENTS, FRAMES - NODES), encoding="utf-8")
    elif path.suffix == ".pvd":
        one.save(path.with_name("a.vtu"))
        path.write_text(pvd_text(["a.vtu"]), encoding="utf-8")
    else:
        one.save(path)


def zdf(path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(path, "w") as file:
        group = file.createGroup("data")
        for name, size in (("rows", 5), ("cols", 8), ("xyz", 3)):
            group.createDimension(name, size)
        group.createVariable("pointcloud", "f4", ("rows", "cols", "xyz"))[:] = POINTS.reshape(5, 8, 3)


def exported(suffix: str) -> Write:
    part = ball((4, 0, 0), 1.0, "b", level=1)
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)

    def write(path: Path) -> None:
        whole = trimesh.Scene({"a": mesh, "b": mesh.copy()}) if suffix in ("3mf", "glb") else mesh
        content = whole.export(file_type=suffix)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return write


def bag(path: Path) -> None:
    import recorded_bags

    def topics(make: Any) -> dict[str, list[Any]]:
        return {"/cloud": [make.cloud(POINTS)], **recorded_bags.depth_topics(make)}

    with TemporaryDirectory() as folder:
        made = recorded_bags.write_bag(Path(folder, f"made{path.suffix}"), 1 if path.suffix == ".bag" else 2, topics)
        path.write_bytes((made if made.is_file() else next(made.glob("*.db3"))).read_bytes())


@lru_cache(1)
def bar() -> Any:
    with TemporaryDirectory() as folder:
        return load_scene(write_bar(Path(folder)))


@lru_cache(1)
def statistical_model() -> StatisticalModel:
    return scene_model(toy_scene(), 12)


@lru_cache(1)
def tiny_model() -> Model:
    torch.manual_seed(0)
    network = Network(PRESETS["tiny"].network, 4).eval()
    model = statistical_model()
    return Model(network, model.rest.names, tuple((i, 2, 3) for i in range(4)), statistical_model=model)


def weights(path: Path) -> None:
    save_model(tiny_model(), path, torch.float16)


def dataset(path: Path) -> None:
    write_toy_dataset(path.parent / "toy", examples=4, points=32, queries=16)
    for file in (path.parent / "toy").iterdir():
        file.rename(path.parent / file.name)
    (path.parent / "toy").rmdir()


def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    one, other = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(one.parameters())
    one(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    return Checkpoint(3, one, other, optimizer)


def state(path: Path) -> None:
    found = registered_states.by_modes(statistical_model())
    save_state(path, state_of(found, "toy", weights="w", frame="camera", unit_m=1.0, T_camera_input=np.eye(4)))


def start(path: Path) -> None:
    corners = (9 * NODES).tolist()
    parts = {"object": {"model": corners, "scan": corners}, "segments": {"left": np.eye(4).tolist()}}
    path.write_text(json.dumps(parts))


def result(path: Path) -> None:
    with new_directory(path.parent) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a.txt").write_text("a")


def claimed(path: Path) -> None:
    if not (path.parent / ".data").exists():
        (path.parent / ".data").mkdir()
        dataset(path.parent / ".data" / "any")
    data = Dataset.load(path.parent / ".data")
    claim_run(path.parent, fit_config(PRESETS["tiny"], data), data, Process())


def scores(path: Path) -> None:
    names = tiny_model().names
    pair = {"iou": 0.5, "miou": 0.25, "miou_up_to_symmetry": 0.25}
    answers = {name: {**pair, "seconds": 1.5} for name in ("network", "modes")}
    facts = {"weights": "w", "examples": 2, "seed": 1_000_000, "noise_std": 0.1}
    write_json(path, {**facts, **pair, "per_segment": dict.fromkeys(names, 0.5), "example_mean": pair, **answers})


def truth(path: Path) -> None:
    scene = write_bar(path.parent, EVERYTHING)
    scan = path.with_name("scan.npy")
    rest = bar().rest
    np.save(scan, POINTS)
    placed = tuple(PlacedSegment(name, np.eye(4), "scan", 9, 0.1, 0.1, 0.1, 0.0, 0.0, 6) for name in rest.names)
    whole = Placement(placed, rest, 0.9, 1.0)
    write_truth(path.parent, path.parent, ScanFile(scan, "mm"), str(scene), rest, whole, "object")


def depth(path: Path) -> object:
    return read_frame(path, InputConfig(intrinsics=path.with_name("camera.json")))


def every_frame(path: Path) -> None:
    for message in read_messages(path, InputConfig()):
        message_frame(message, path, InputConfig())


exactly_read = partial(read_point_cloud, drop_invalid=True)
of_segment = partial(read_states, names=("a",))


LAYERS = f"""NRRD0004
type: uchar
dimension: 4
space: left-posterior-superior
sizes: 2 3 3 4
space directions: none (1,0,0) (0,1,0) (0,0,2)
kinds: list domain domain domain
encoding: ascii
space origin: (0,0,0)
{chr(10).join(f"Segment{k}_Name:=s{k}{chr(10)}Segment{k}_LabelValue:=1{chr(10)}Segment{k}_Layer:={k}" for k in (0, 1))}
Segment1_Color:=1 0 0.5

{"1 0 1 1 0 0 " * 12}
"""


class Target(NamedTuple):
    """What makes a kind of file in a folder of its own, what reads it, and the library that this needs."""

    write: Write
    read: Callable[[Path], object]
    library: str = "numpy"


ALL = {
    "ascii.ply": Target(partial(write_cloud, save_ply, "ascii"), exactly_read),
    "labelled.ply": Target(lambda p: write_points_ply(p, cloud()), exactly_read),
    **{f"{kind}.pcd": Target(partial(write_cloud, save_pcd, kind), exactly_read) for kind in PCD},
    "cloud.csv": Target(rows(",", "x,y,z\n"), exactly_read),
    "cloud.pts": Target(rows(" ", "40\n"), read_point_cloud),
    "cloud.npy": Target(image(POINTS), exactly_read),
    "cloud.npz": Target(lambda p: np.savez(p, points=POINTS, more=DEPTH), exactly_read),
    "cloud.zdf": Target(zdf, exactly_read, "netCDF4"),
    "depth.png": Target(image(DEPTH), depth),
    "depth.tif": Target(image(DEPTH), depth),
    "packed.tif": Target(image(DEPTH.astype(np.float32) / 1000, compression="tiff_deflate"), depth),
    "depth.exr": Target(image(DEPTH.astype(np.float32) / 1000), depth, "OpenEXR"),
    "depth.npy": Target(image(DEPTH), depth),
    "mask.png": Target(
        image(np.stack([255 * (DEPTH > 700).astype(np.uint8)] * 3, axis=-1)), lambda p: read_mask(p, (16, 12))
    ),
    **{f"frames.{kind}": Target(bag, every_frame, "rosbags") for kind in ("bag", "db3", "mcap")},
    "camera.json": Target(lambda p: write_camera(p, CAMERA), read_intrinsics),
    "ros.yaml": Target(text(ROS_YAML), read_intrinsics),
    "scene_camera.json": Target(text(json.dumps(BOP)), lambda p: read_intrinsics(p, (16, 12), index=1)),
    **{f"mesh.{kind}": Target(exported(kind), read_segmented_mesh) for kind in ("stl", "glb", "off")},
    "mesh.3mf": Target(exported("3mf"), read_segmented_mesh, "lxml"),
    "mesh.dae": Target(exported("dae"), read_segmented_mesh, "collada"),
    "laptop.urdf": Target(text(LAPTOP), lambda p: scene_of_meshes([p]), "yourdfpy"),
    "laptop.sdf": Target(text(LAPTOP_SDF), lambda p: scene_of_meshes([p]), "yourdfpy"),
    "text.stl": Target(exported("stl_ascii"), lambda p: read_attachments([p])),
    "own.glb": Target(lambda p: write_segments_glb(p, segments()), lambda p: read_attachments([p])),
    "own.obj": Target(lambda p: write_segments_obj(p, segments()), lambda p: read_attachments([p])),
    "own.ply": Target(lambda p: write_segments_ply(p, segments()), lambda p: read_attachments([p])),
    "poses.csv": Target(text("x,y,z,qx,qy,qz,qw,note\n1,2,3,0,0,0,1,a\n4,5,6,1,0,0,0,b\n"), read_pose_table),
    "labels.nii": Target(lambda p: write_labels_nifti(p, grid(), COLORS), read_label_volume, "nibabel"),
    "labels.nii.gz": Target(lambda p: write_labels_nifti(p, grid(), COLORS), read_label_volume, "nibabel"),
    "labels.seg.nrrd": Target(lambda p: write_labels_seg_nrrd(p, grid(), COLORS), read_label_volume, "nrrd"),
    "layers.seg.nrrd": Target(text(LAYERS), read_label_volume, "nrrd"),
    "tetrahedra.npz": Target(lambda p: np.savez(p, rest_nodes=NODES, tetrahedra=ELEMENTS, nodes=FRAMES), of_segment),
    "surfaces.npz": Target(lambda p: np.savez(p, a=FRAMES), of_segment),
    **{f"frames.{kind}": Target(vtk, of_segment, "pyvista") for kind in ("vtu", "pvd", "xdmf")},
    "a/1.obj": Target(exported("obj"), lambda p: of_segment(p.parents[1])),
    "bar.yaml": Target(lambda p: write_bar(p.parent, EVERYTHING), load_scene),
    "left.stl": Target(lambda p: write_bar(p.parent, EVERYTHING), lambda p: load_scene(p.with_name("bar.yaml"))),
    "weights.safetensors": Target(weights, load_model),
    "manifest.json": Target(dataset, lambda p: Dataset.load(p.parent)),
    "shard-00000.safetensors": Target(dataset, lambda p: Dataset.load(p.parent)),
    "states.safetensors": Target(lambda p: save_statistical_model(statistical_model(), p), load_statistical_model),
    "checkpoint.safetensors": Target(
        lambda p: save_checkpoint(p.parent, checkpoint()), lambda p: load_checkpoint(p.parent, checkpoint())
    ),
    "state.json": Target(state, lambda p: load_state(p, statistical_model())),
    "start.json": Target(start, lambda p: read_start(p, bar().rest, 1.0)),
    "view.npz": Target(lambda p: p.write_bytes((SHIPPED / "rope.npz").read_bytes()), load_view),
    "out/.mereo.json": Target(result, lambda p: check_new_directory(p.parent, force=True)),
    "config.json": Target(claimed, claimed),
    "metrics.json": Target(scores, lambda p: card("toy", tiny_model(), [read_metrics(p)], b"")),
    "truth.json": Target(truth, read_truth),
}
TARGETS = {name: target for name, target in ALL.items() if find_spec(target.library) is not None}


def inputs(name: str, folder: Path, seed: int) -> Iterator[tuple[bytes, bool, str]]:
    """Damaged files of a kind without end, in ``folder``: content, whether it was taken, and how it broke the rule."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    TARGETS[name].write(path)
    whole = path.read_bytes()
    number = 0
    assert fault_of(TARGETS[name].read, path) == (True, ""), f"{name} breaks the rule before it is damaged"
    while True:
        content = damaged(whole, Random(f"{seed}/{name}/{number}"))
        path.write_bytes(content)
        yield content, *fault_of(TARGETS[name].read, path)
        number += 1
