"""What is damaged: a small valid file of every kind that mereo reads, and what reads it.

``TARGETS`` are by the name of the file. Those whose library is missing are left out, as their readers are.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from camera_files import write_camera
from fuzz_files import (
    BOP,
    CAMERA,
    DEPTH,
    FRAMES,
    NERF,
    NODES,
    POINTS,
    ROS_YAML,
    TURNS,
    array,
    arrays,
    bag,
    carried,
    checkpoint,
    dataset,
    depth,
    every_frame,
    exactly_read,
    exported,
    exr,
    image,
    masked,
    nifti,
    pcd,
    ply,
    read_registration,
    rest,
    rows,
    scene_file,
    start,
    state,
    statistical_model,
    text,
    view,
    volume_scene,
    vtk,
    weights,
    zdf,
)
from fuzz_folders import claimed, placed, replaced, result, run, scored, scores, truth
from written_results import COLORS, grid, segments

from mereo.io.attachments import Positions, read_pose_table, write_attachment
from mereo.io.intrinsics import read_intrinsics
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import read_point_cloud
from mereo.io.simulation_states import read_states
from mereo.io.volume_files import read_label_volume
from mereo.io.writers.glb import write_segments_glb
from mereo.io.writers.meshes import write_points_ply, write_segments_obj, write_segments_ply
from mereo.io.writers.volumes import write_labels_seg_nrrd
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import load_statistical_model, save_statistical_model
from mereo.synthesis.sample_views import load_view
from mereo_learning.dataset import Dataset
from mereo_learning.placement import read_start
from mereo_learning.run_directory import load_checkpoint, save_checkpoint


@dataclass(frozen=True)
class Target:
    """Kind of input.

    Attributes:
        name: of the file that is damaged, in a folder of its own; its folders stand before it.
        write: makes the file, and what it needs beside it, in that folder.
        read: reads it.
        folder: it is read with the folder that it lies in, which refusals may name instead.
        library: that reads it.
    """

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    folder: bool = False
    library: str = "numpy"


TRUECOLOR = np.stack([DEPTH.astype(np.uint8)] * 3, axis=-1)
TETRAHEDRA = {"rest_nodes": NODES, "tetrahedra": np.array([[0, 1, 2, 3]]), "nodes": FRAMES}
# (name, write, read, read with its folder, library)
ALL: tuple[Target, ...] = (
    Target("ascii.ply", ply("ascii"), exactly_read),
    Target("little.ply", ply("binary_little_endian"), exactly_read),
    Target("big.ply", ply("binary_big_endian"), read_point_cloud),
    Target("labelled.ply", lambda p: write_points_ply(p, _labelled()), exactly_read),
    *(Target(f"{kind}.pcd", pcd(kind), exactly_read) for kind in ("ascii", "binary", "binary_compressed")),
    Target("cloud.xyz", rows(" "), exactly_read),
    Target("cloud.csv", rows(",", "x,y,z\n"), exactly_read),
    Target("cloud.pts", rows(" ", "40\n"), read_point_cloud),
    Target("cloud.npy", array(POINTS), exactly_read),
    Target("cloud.npz", arrays(points=POINTS, more=DEPTH), exactly_read),
    Target("cloud.zdf", zdf, exactly_read, library="netCDF4"),
    Target("depth.png", image(DEPTH), depth),
    Target("depth.tif", image(DEPTH), depth),
    Target("packed.tif", image(DEPTH.astype(np.float32) / 1000, compression="tiff_deflate"), depth),
    Target("depth.exr", exr, depth, library="OpenEXR"),
    Target("depth.npy", array(DEPTH), depth),
    Target("mask.png", image(TRUECOLOR), masked),
    Target("mask.jpg", image(TRUECOLOR), masked),
    *(Target(f"frames.{suffix}", bag, every_frame, library="rosbags") for suffix in ("bag", "db3", "mcap")),
    Target("camera.json", lambda p: write_camera(p, CAMERA), read_intrinsics),
    Target("ros.yaml", text(ROS_YAML), read_intrinsics),
    Target("transforms.json", text(json.dumps(NERF)), lambda p: read_intrinsics(p, (16, 12), index=1)),
    Target("scene_camera.json", text(json.dumps(BOP)), lambda p: read_intrinsics(p, (16, 12), index=1)),
    *(Target(f"mesh.{suffix}", exported(suffix), read_segmented_mesh) for suffix in ("stl", "glb", "off")),
    Target("mesh.3mf", exported("3mf"), read_segmented_mesh, library="lxml"),
    Target("text.stl", exported("stl_ascii"), carried),
    Target("own.glb", lambda p: write_segments_glb(p, segments()), carried),
    Target("own.obj", lambda p: write_segments_obj(p, segments()), carried),
    Target("own.ply", lambda p: write_segments_ply(p, segments()), carried),
    Target("carried.xyz", lambda p: write_attachment(p, Positions(POINTS), 1.0, np.eye(3), 1.0), carried),
    Target("poses.csv", text(TURNS), read_pose_table),
    Target("labels.nii", nifti, read_label_volume, library="nibabel"),
    Target("labels.nii.gz", nifti, read_label_volume, library="nibabel"),
    Target("labels.seg.nrrd", lambda p: write_labels_seg_nrrd(p, grid(), COLORS), read_label_volume, library="nrrd"),
    Target("tetrahedra.npz", arrays(**TETRAHEDRA), lambda p: read_states(p, ("a",))),
    Target("surfaces.npz", arrays(a=FRAMES), lambda p: read_states(p, ("a",))),
    Target("frames.npy", array(FRAMES), lambda p: read_states(p, ("a",))),
    *(
        Target(f"frames.{suffix}", vtk, lambda p: read_states(p, ("a",)), library="pyvista")
        for suffix in ("vtk", "vtu", "pvd", "xdmf")
    ),
    *(
        Target(f"a/1.{suffix}", exported(suffix), lambda p: read_states(p.parents[1], ("a",)), folder=True)
        for suffix in ("obj", "stl", "ply", "off")
    ),
    Target("bar.yaml", scene_file, load_scene),
    Target("volume.yaml", volume_scene, load_scene, library="nrrd"),
    Target(
        "left.stl",
        lambda p: scene_file(p.with_name("bar.yaml")),
        lambda p: load_scene(p.with_name("bar.yaml")),
        folder=True,
    ),
    Target("weights.safetensors", weights, load_model),
    Target("manifest.json", dataset, lambda p: Dataset.load(p.parent), folder=True),
    Target("shard-00000.safetensors", dataset, lambda p: Dataset.load(p.parent), folder=True),
    Target("template.safetensors", dataset, lambda p: Dataset.load(p.parent), folder=True),
    Target("states.safetensors", lambda p: save_statistical_model(statistical_model(), p), load_statistical_model),
    Target(
        "checkpoint.safetensors",
        lambda p: save_checkpoint(p.parent, checkpoint()),
        lambda p: load_checkpoint(p.parent, checkpoint()),
    ),
    Target("state.json", state, read_registration),
    Target("start.json", start, lambda p: read_start(p, rest(), 1.0)),
    Target("view.npz", view, load_view),
    Target("out/.mereo.json", result, replaced, folder=True),
    Target("config.json", run, claimed, folder=True),
    Target("metrics.json", scores, scored),
    Target("truth.json", truth, placed, folder=True),
)
TARGETS = {target.name: target for target in ALL if find_spec(target.library) is not None}


def _labelled() -> Any:
    from written_results import cloud

    return cloud()
