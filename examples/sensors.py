"""One view under each error of a depth camera: what is left in the cloud, and what should not be there.

    python examples/sensors.py --scene robot --output sensors.png

Colour is depth, bright is near. Red pixels show something else than the object: background or occluder that the mask
lets in. Grey is a tool or hand that the mask leaves out. The same seed shows the same state from the same place under
every sensor.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from mereo.geometry.camera import DepthImage
from mereo.geometry.solids import Solids
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import OBJECT, OCCLUDER
from mereo.synthesis.config import SENSORS, GenerateConfig, SensorConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.examples import sample_view
from mereo.visualization.contact_sheets import Picture, contact_sheet, depth_to_rgb, enlarge, save_png

STRAY, LEFT_OUT = (214, 39, 40), (176, 180, 188)
OFF = SensorConfig()
TERMS: dict[str, SensorConfig] = {
    "the paper's noise alone": OFF,
    "axial noise, 4 times": replace(OFF, axial=4.0),
    "lateral noise, 4 times": replace(OFF, lateral=4.0),
    "depth steps, 16 times": replace(OFF, quantization=16.0),
    "dropout at grazing angles": replace(OFF, dropout=1.0),
    "holes": replace(OFF, holes=5.0),
    "flying pixels": replace(OFF, flying=1.0, background=1.0),
    "mask off by 1.5 pixels": replace(OFF, mask_offset_px=1.5, mask_shift_px=1.0, background=1.0),
    "tool": replace(OFF, tool=1.0),
    "hand": replace(OFF, hand=1.0),
    "--sensor structured-light": SENSORS["structured-light"],
    "--sensor time-of-flight": SENSORS["time-of-flight"],
}


def draw(seen: SimulatedView, limits: tuple[float, float], width: int) -> Picture:
    """The middle of the image: the cloud's pixels by depth, strays in red, occluders left out by the mask in grey."""
    picture = depth_to_rgb(DepthImage(np.clip(seen.image.depth, 0, limits[1]), seen.image.camera), limits)
    left_out = seen.whole.valid & ~seen.mask
    picture = np.where((left_out & (seen.source == OCCLUDER))[..., None], np.array(LEFT_OUT, dtype=np.uint8), picture)
    stray = seen.image.valid & (seen.source != OBJECT)
    picture = np.where(stray[..., None], np.array(STRAY, dtype=np.uint8), picture)
    rows, columns = (slice(size // 6, size - size // 6) for size in picture.shape[:2])
    return enlarge(picture[rows, columns], width)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw one view under each error of a depth camera.")
    parser.add_argument("--scene", default="robot")
    parser.add_argument("--output", type=Path, default=Path("sensors.png"), help="the PNG to write")
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--force", action="store_true", help="replace the file where it exists")
    options = parser.parse_args()
    try:
        check_file_place(options.output, force=options.force)
    except (OSError, ValueError) as error:
        parser.error(str(error))

    view = sample_view(load_scene(options.scene), GenerateConfig(noise_std=0.0), example_rng(options.seed, 0))
    solids = Solids(view.mesh)
    camera = view.depth.camera
    near = view.depth.depth[view.depth.valid].min()
    far = view.depth.depth.max()
    pictures, captions = [], []
    for name, sensor in TERMS.items():
        seen = observe(solids, camera, 0.1, sensor, example_rng(options.seed, 1))
        pictures.append(draw(seen, (float(near), float(far)), 4 * 64))
        stray = int(seen.image.valid.sum()) - seen.object_points
        captions.append(f"{name}: {seen.object_points} pixels" + (f" + {stray}" if stray else ""))
    with atomic_file(options.output, force=options.force) as partial:
        save_png(partial, contact_sheet(pictures, captions, 4, f"{options.scene}: one view, many sensors"))
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()
