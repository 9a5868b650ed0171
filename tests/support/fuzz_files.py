"""Small valid files of every kind that mereo reads, for the tests that damage them: ``write(path)`` makes one."""

import gzip
import io
import json
import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from camera_files import write_camera
from lattice import pvd_text, xdmf_text
from PIL import Image
from scene_files import write_bar
from shapes import ball, box
from toy_data import write_toy_dataset
from written_results import COLORS, grid

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.attachments import read_attachments
from mereo.io.config import InputConfig
from mereo.io.readers import read_mask, read_point_cloud
from mereo.io.sensor_frame import read_frame, read_frames
from mereo.io.writers.volumes import write_labels_nifti, write_labels_seg_nrrd
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import save_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import save_statistical_model
from mereo.synthesis.sample_views import SHIPPED as VIEWS
from mereo_learning.config import PRESETS
from mereo_learning.run_directory import Checkpoint

POINTS = np.random.default_rng(0).normal((0, 0, 2), 0.2, (40, 3)).round(3)
DEPTH = np.random.default_rng(0).integers(500, 900, (12, 16)).astype(np.uint16)
CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
TURNS = "x,y,z,qx,qy,qz,qw,note\n1,2,3,0,0,0,1,a\n4,5,6,1,0,0,0,b\n"
ROS_YAML = """\
image_width: 16
image_height: 12
camera_matrix: {rows: 3, cols: 3, data: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [20, 0, 7.5, 0, 0, 20, 5.5, 0, 0, 0, 1, 0]}
"""
NERF = {"w": 16, "h": 12, "frames": [{"file_path": "d.png", "fl_x": 20, "fl_y": 20, "cx": 8, "cy": 6}] * 2}
BOP = {str(i): {"cam_K": [20, 0, 8, 0, 20, 6, 0, 0, 1], "depth_scale": 0.1} for i in (1, 2)}


# --- files that are written here --------------------------------------------------------------------------------------


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content, encoding="utf-8")


def rows(mark: str, head: str = "") -> Callable[[Path], object]:
    return text(head + "".join(mark.join(map(str, row)) + "\n" for row in POINTS.tolist()))


def ply(order: str) -> Callable[[Path], object]:
    head = f"ply\nformat {order} 1.0\nelement vertex 40\nproperty float x\nproperty float y\nproperty float z\n"
    body = POINTS.astype(">f4" if "big" in order else "<f4").tobytes()
    lines = "".join("{} {} {}\n".format(*row) for row in POINTS.tolist()).encode()
    return lambda path: path.write_bytes(f"{head}end_header\n".encode() + (lines if order == "ascii" else body))


def pcd(layout: str) -> Callable[[Path], object]:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
    columns = np.ascontiguousarray(POINTS.T.astype("<f4")).tobytes()  # literals alone are valid LZF
    packed = b"".join(bytes([len(c) - 1]) + c for c in (columns[i : i + 32] for i in range(0, len(columns), 32)))
    body = {
        "ascii": "".join("{} {} {}\n".format(*row) for row in POINTS.tolist()).encode(),
        "binary": POINTS.astype("<f4").tobytes(),
        "binary_compressed": struct.pack("<II", len(packed), len(columns)) + packed,
    }
    return lambda path: path.write_bytes(f"{head}DATA {layout}\n".encode() + body[layout])


def image(values: np.ndarray, **options: Any) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        Image.fromarray(values).save(path, **options)
        write_camera(path.parent / "camera.json", CAMERA)

    return write


def array(values: np.ndarray) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        np.save(path, values)
        write_camera(path.parent / "camera.json", CAMERA)

    return write


NODES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FRAMES = np.stack([NODES, NODES * 1.1, NODES + 1])


def vtk(path: Path) -> None:
    """A tetrahedron in VTK's formats, or one that names others of three frames."""
    import pyvista

    one = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: np.array([[0, 1, 2, 3]])}, NODES)
    one.point_data["u"] = FRAMES[1] - NODES
    if path.suffix == ".xdmf":
        path.write_text(xdmf_text(NODES, np.array([[0, 1, 2, 3]]), FRAMES - NODES), encoding="utf-8")
    elif path.suffix == ".pvd":
        one.save(path.with_name("a.vtu"))
        path.write_text(pvd_text(["a.vtu"]), encoding="utf-8")
    else:
        one.save(path)


def exr(path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": DEPTH.astype(np.float32) / 1000}) as file:
        file.write(str(path))
    write_camera(path.parent / "camera.json", CAMERA)


def zdf(path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(path, "w") as file:
        group = file.createGroup("data")
        for name, size in (("rows", 5), ("cols", 8), ("xyz", 3)):
            group.createDimension(name, size)
        group.createVariable("pointcloud", "f4", ("rows", "cols", "xyz"))[:] = POINTS.reshape(5, 8, 3)


def exported(suffix: str) -> Callable[[Path], object]:
    parts = {"a": box((0, 0, 0), (1, 2, 3), "a"), "b": ball((4, 0, 0), 1.0, "b", level=1)}

    def write(path: Path) -> None:
        meshes = {name: trimesh.Trimesh(part.vertices, part.faces, process=False) for name, part in parts.items()}
        several = suffix in ("3mf", "glb")
        done: Any = (trimesh.Scene(meshes) if several else meshes["b"]).export(file_type=suffix)
        path.write_bytes(done if isinstance(done, bytes) else done.encode())

    return write


def nifti(path: Path) -> None:
    write_labels_nifti(path.parent / "l.nii.gz", grid(), COLORS)
    content = (path.parent / "l.nii.gz").read_bytes()
    (path.parent / "l.nii.gz").unlink()
    path.write_bytes(content if path.suffix == ".gz" else gzip.decompress(content))


def arrays(**named: np.ndarray) -> Callable[[Path], object]:
    return lambda path: np.savez(path, **named)


def bag(path: Path) -> None:
    import recorded_bags

    def topics(make: Any) -> dict[str, list[Any]]:
        return {"/cloud": [make.cloud(POINTS)], **recorded_bags.depth_topics(make)}

    made = recorded_bags.write_bag(path.parent / f"made{path.suffix}", 1 if path.suffix == ".bag" else 2, topics)
    source = made if made.is_file() else next(made.glob("*.db3"))
    path.write_bytes(source.read_bytes())
    for file in path.parent.rglob("*"):
        if file != path and file.is_file():
            file.unlink()
    for folder in [f for f in path.parent.iterdir() if f.is_dir()]:
        folder.rmdir()


def scene_file(path: Path) -> None:
    import scene_code

    write_bar(path.parent, scene_code.EVERYTHING)


def volume_scene(path: Path) -> None:
    write_labels_seg_nrrd(path.parent / "l.seg.nrrd", grid(), COLORS)
    text("name: v\nunits: mm\nlabels: l.seg.nrrd\nnames: {3: box}\ncells: 12\nsize: 20\n")(path)


@lru_cache(1)
def bar() -> Any:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return load_scene(write_bar(Path(folder)))


@lru_cache(1)
def statistical_model() -> Any:
    from toy_scene import toy_scene

    from mereo.scenes.random_states import scene_model

    return scene_model(toy_scene(), 12)


def weights(path: Path) -> None:
    save_model(tiny_model(), path, torch.float16)


def dataset(path: Path) -> None:
    write_toy_dataset(path.parent / "toy", examples=4, points=32, queries=16)
    for file in (path.parent / "toy").iterdir():
        file.rename(path.parent / file.name)
    (path.parent / "toy").rmdir()
    save_statistical_model(statistical_model(), path.parent / "states.safetensors")


@lru_cache(1)
def tiny_model() -> Model:
    torch.manual_seed(0)
    network = Network(PRESETS["tiny"].network, 4).eval()
    names = statistical_model().rest.names
    return Model(network, names, tuple((i, 2, 3) for i in range(4)), statistical_model=statistical_model())


def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    one, other = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(one.parameters())
    one(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    return Checkpoint(3, one, other, optimizer)


def state(path: Path) -> None:
    import registered_states as cases

    from mereo.fitting.registration.state import save_state, state_of

    found = state_of(cases.by_modes(statistical_model()), "toy", weights="w", frame="camera", unit_m=1.0,
                     T_camera_input=np.eye(4))  # fmt: skip
    save_state(path, found)


def read_registration(path: Path) -> object:
    from mereo.fitting.registration.state import load_state

    return load_state(path, statistical_model())


def start(path: Path) -> None:
    corners = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9.0]]).tolist()
    pose = np.eye(4).tolist()
    path.write_text(json.dumps({"object": {"model": corners, "scan": corners}, "segments": {"left": pose}}))


def rest() -> SegmentedMesh:
    found: SegmentedMesh = bar().rest
    return found


def depth(path: Path) -> object:
    return read_frame(path, InputConfig(intrinsics=path.parent / "camera.json"))


def every_frame(path: Path) -> None:
    for message, read in read_frames(path, InputConfig()):
        assert message.name
        read()


def view(path: Path) -> None:
    path.write_bytes((VIEWS / "rope.npz").read_bytes())


def exactly_read(path: Path) -> object:
    return read_point_cloud(path, drop_invalid=True)


def carried(path: Path) -> object:
    return read_attachments([path])


def masked(path: Path) -> object:
    return read_mask(path, (16, 12))


def stored(content: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, content)
    return file.getvalue()
