"""Find an object in a whole depth image, among other things, and draw the answer into the image.

    python examples/whole_frame.py
    python examples/whole_frame.py --input depth.png --intrinsics camera.json --object bottle.obj --units m --way rigid

Without an input a bent bunny is put on a desk between a ball, a can and a box, and seen by a simulated camera.
"""

from pathlib import Path

import numpy as np
import trimesh
import tyro
from PIL import Image
from scipy.spatial.transform import Rotation

import mereo
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import LengthUnit, Way
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rigid
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.sensor_frame import SensorFrame
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

DOWN = Rotation.from_euler("x", 35, degrees=True)
"""From a desk with y down into the frame of a camera that looks down on it."""

CAMERA = Camera(480, 360, 460.0, 460.0, 240.0, 180.0)


def on_desk(mesh: SegmentedMesh, x: float, away: float) -> SegmentedMesh:
    """Put a mesh with y up, metres, on the desk."""
    low, high = mesh.bounds
    middle = (low + high) / 2
    turned = mesh.transformed(rigid(np.diag([1.0, -1.0, -1.0]), np.array([x - middle[0], low[1], away + middle[2]])))
    return turned.transformed(rigid(DOWN.as_matrix(), np.array([0.0, 0.06, 0.75])))


def simple(name: str, mesh: trimesh.Trimesh) -> SegmentedMesh:
    """A thing of one piece."""
    return SegmentedMesh((Segment(name, (128, 128, 128), np.asarray(mesh.vertices), np.asarray(mesh.faces)),))


def desk() -> DepthImage:
    """A bent bunny among other things, metres."""
    scene = load_scene("bunny")
    state = scene.sample_state(example_rng(1000, 3)).mesh
    unit = scene.unit_m or 1.0
    bunny = state.with_vertices([unit * part.vertices for part in state.segments])
    upright = trimesh.creation.cylinder(0.035, 0.13)
    upright.apply_transform(rigid(Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.zeros(3)))
    table, wall = trimesh.creation.box((3.0, 0.02, 3.0)), trimesh.creation.box((3.0, 2.0, 0.02))
    placed = [
        on_desk(bunny, -0.02, 0.0),
        on_desk(simple("ball", trimesh.creation.icosphere(4, 0.04)), 0.16, -0.06),
        on_desk(simple("can", upright), -0.22, 0.06),
        on_desk(simple("box", trimesh.creation.box((0.12, 0.08, 0.07))), 0.12, 0.18),
        on_desk(simple("wall", wall), 0.0, 0.6),
        on_desk(simple("table", table), 0.0, 0.0).transformed(rigid(np.eye(3), DOWN.apply([0.0, 0.02, 0.0]))),
    ]
    everything = SegmentedMesh(tuple(part for mesh in placed for part in mesh.segments))
    return add_depth_noise(render_depth(everything, CAMERA), 3e-4, np.random.default_rng(0))


def drawn(image: DepthImage, mesh: SegmentedMesh | None) -> np.ndarray:
    """The image in grey, near is bright, with the shaded segments of a mesh in their colours."""
    inverse = np.where(image.valid, 1 / np.maximum(image.depth, 1e-9), np.nan)
    low, high = np.nanquantile(inverse, [0.02, 0.98])
    grey = np.nan_to_num(np.clip((inverse - low) / (high - low), 0.0, 1.0), nan=0.0)
    picture = np.repeat((30 + 190 * grey)[..., None], 3, axis=2)
    if mesh is not None:
        rays = image.camera.directions().reshape(-1, 3)
        parts = [Solids(SegmentedMesh((part,))).first_hit(rays) for part in mesh.segments]
        nearest = np.argmin([hits.distance for hits in parts], axis=0)
        for number, (part, hits) in enumerate(zip(mesh.segments, parts, strict=True)):
            shown = np.flatnonzero((nearest == number) & np.isfinite(hits.distance))
            facing = np.abs(np.einsum("ni,ni->n", hits.normal[shown], rays[shown]))
            facing /= np.linalg.norm(hits.normal[shown], axis=1) * np.linalg.norm(rays[shown], axis=1)
            picture.reshape(-1, 3)[shown] = (0.35 + 0.65 * facing[:, None]) * np.array(part.color)
    return picture.astype(np.uint8)


def main(
    input: Path | None = None,
    intrinsics: Path | None = None,
    object: tuple[str, ...] = ("bunny",),
    units: LengthUnit | None = None,
    way: Way = "auto",
    output: Path = Path("out/whole_frame.png"),
    force: bool = False,
) -> None:
    try:
        check_file_place(output, force=force, inputs=[] if input is None else [input])
        if input is None:
            image = desk()
            frame: SensorFrame = mereo.load_frame(image, unit_m=1.0)
            model = mereo.load_object(load_scene("bunny"))
        else:
            frame = mereo.load_frame(input, intrinsics=intrinsics)
            model = mereo.load_object(list(object), units=units, deformations=way)
        result = mereo.reconstruct(frame, model)
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {error}") from None
    assert frame.whole is not None
    print(result.seen, f"known: {result.known}", sep="\n")
    both = [drawn(frame.whole, mesh) for mesh in (None, result.surfaces)]
    with atomic_file(output, force=force) as partial:
        Image.fromarray(np.concatenate(both, axis=1)).save(partial, format="png")
    print(f"wrote {output.name}")


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,))
