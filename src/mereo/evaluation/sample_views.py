"""Truth on a grid, and test frames: a depth image with the truth behind it, in one small file.

Two frames, rendered from test seeds, come with the package, so that a fresh clone can be tried without any download.
"""

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.labels import LabelGrid
from mereo.io.atomic_files import atomic_file
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

SHIPPED = Path(__file__).parents[1] / "frames"


DEPTH_STEP = 0.005
"""Depth is stored as whole multiples of this many scene units, a twentieth of the sensor's noise."""


@dataclass(frozen=True, eq=False)
class SampleView:
    """One view with its truth.

    Attributes:
        scene, seed: where it comes from: example 0 of this test seed.
        depth: the noisy depth image, scene units.
        truth: in the camera frame.
    """

    scene: str
    seed: int
    depth: DepthImage
    truth: TruthGrid


def make_frame(scene: str, seed: int = TEST_SEED_START, cells: int = 100) -> SampleView:
    """Example 0 of a test seed, its depth rounded as ``save_frame`` stores it."""
    view = sample_view(load_scene(scene).for_seed(seed), GenerateConfig(), example_rng(seed, 0))
    rounded = np.rint(view.depth.depth / DEPTH_STEP)
    if rounded.max() > 65535:
        raise ValueError(
            f"scene {scene!r} is {view.depth.depth.max():.4g} units away; a frame stores up to {65535 * DEPTH_STEP:g}: "
            "move its camera workspace closer"
        )
    return SampleView(scene, seed, DepthImage(rounded * DEPTH_STEP, view.depth.camera), truth_grid(view.mesh, cells))


def save_frame(path: str | Path, frame: SampleView) -> None:
    """Write a compressed .npz (about 50 kB): 16-bit depth, intrinsics, true labels."""
    camera, grid = frame.depth.camera, frame.truth.grid
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            scene=np.array(frame.scene),
            seed=np.array(frame.seed),
            depth=np.rint(frame.depth.depth / DEPTH_STEP).astype(np.uint16),
            depth_step=np.array(DEPTH_STEP),
            intrinsics=np.array(
                [camera.focal_x_px, camera.focal_y_px, camera.center_x_px, camera.center_y_px], dtype=np.float64
            ),
            labels=grid.labels,
            kept=frame.truth.kept,
            origin=grid.origin,
            spacing=grid.spacing,
            names=np.asarray(grid.names),
        )


def shipped_frames() -> tuple[str, ...]:
    """Names that ``load_frame`` knows without a path."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.npz")))


def load_frame(name: str | Path) -> SampleView:
    """A shipped frame by name, or a file. Raises ``FileNotFoundError`` or ``ValueError``."""
    shipped = SHIPPED / f"{name}.npz"
    path = shipped if shipped.is_file() else Path(name)
    if not path.is_file():
        known = ", ".join(shipped_frames()) or "none"
        raise FileNotFoundError(f"there is no frame {str(name)!r}; give a .npz file or a shipped name: {known}")
    try:
        # opened here because numpy leaves a damaged file open
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return _frame({key: file[key] for key in file.files})
    except (KeyError, ValueError, OSError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path} is not a frame of mereo ({error}); write it with `save_frame`") from None


def _frame(stored: dict[str, np.ndarray]) -> SampleView:
    height, width = stored["depth"].shape
    camera = Camera(width, height, *(float(value) for value in stored["intrinsics"]))
    names = tuple(str(name) for name in stored["names"])
    grid = LabelGrid(stored["labels"], stored["origin"], stored["spacing"], names)
    depth = DepthImage(stored["depth"] * float(stored["depth_step"]), camera)
    return SampleView(str(stored["scene"]), int(stored["seed"]), depth, TruthGrid(grid, stored["kept"]))
