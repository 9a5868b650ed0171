"""Sample views: a depth image with the truth behind it, in one small file, to try a model on.

A few views of test seeds (benchmarks/shipped_frames.py) come with the package, so that a fresh clone can be tried
without any download.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import Names
from mereo.geometry.labels import LabelGrid
from mereo.geometry.metrics import TruthGrid
from mereo.io.errors import AnyPath, SizeError, quiet, reason
from mereo.io.readers import read_arrays, read_point_cloud
from mereo.io.sensor_frame import SensorFrame
from mereo.scenes.scene import GUESSED_UNIT_M

SHIPPED = Path(__file__).parents[1] / "frames"

SHIPPED_SCAN = "bun000"
"""Name of the shipped range scan of the Stanford bunny: 4,000 of its 40,256 points, evenly spread."""


@dataclass(frozen=True, eq=False)
class SampleView:
    """One rendered view of a scene with its truth.

    Attributes:
        scene: name of the scene.
        seed: test seed of which it is example 0.
        depth: the noisy depth image, scene units.
        truth: true labels on a grid, in the camera frame.
        unit_m: metres per scene unit; None where the object's true size is not known.
    """

    scene: str
    seed: int
    depth: DepthImage
    truth: TruthGrid
    unit_m: float | None = None

    @property
    def metres(self) -> float:
        """Metres per scene unit; ``GUESSED_UNIT_M`` where the object's true size is not known."""
        return self.unit_m or GUESSED_UNIT_M


def shipped_views() -> Names:
    """Names of the views that come with the package, which ``load_view`` knows without a path."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.npz")))


def shipped_frames() -> Names:
    """Names of the frames that come with the package, which ``shipped_frame`` knows."""
    return (SHIPPED_SCAN, *shipped_views())


def load_view(name: AnyPath) -> SampleView:
    """Sample view that is shipped under a name, or read from a file.

    Raises ``FileNotFoundError`` where there is none, ``ValueError`` for a file that is something else.
    """
    shipped = SHIPPED / f"{name}.npz"
    path = shipped if shipped.is_file() else Path(name)
    if not path.is_file():
        known = ", ".join(shipped_views()) or "none"
        raise FileNotFoundError(f"there is no sample view {str(name)!r}; give a .npz file or a shipped name: {known}")
    try:
        with quiet():
            return _view_of(read_arrays(path))
    except SizeError:
        raise
    except Exception as error:  # whatever a damaged archive makes of zlib, tokenize and numpy
        raise ValueError(
            f"{path} is not a sample view of mereo ({reason(error)}); benchmarks/shipped_frames.py makes them"
        ) from None


def shipped_frame(name: str) -> SensorFrame:
    """Frame that is shipped under a name, in metres: a rendered depth image, or ``SHIPPED_SCAN``.

    An object whose true size is not known is taken to have scene units of ``GUESSED_UNIT_M``. Raises
    ``FileNotFoundError`` for an unknown name.
    """
    if name == SHIPPED_SCAN:
        path = SHIPPED / f"{name}.ply"
        return SensorFrame(path, read_point_cloud(path), 1.0, "scanner", message="shipped scan")
    view = load_view(name)
    image = DepthImage(view.depth.depth * view.metres, view.depth.camera)
    path = SHIPPED / f"{name}.npz"
    return SensorFrame(path, image.to_points(), 1.0, "camera", image, "shipped frame", whole=image)


def _view_of(stored: dict[str, np.ndarray]) -> SampleView:
    height, width = stored["depth"].shape
    camera = Camera(width, height, *(float(value) for value in stored["intrinsics"]))
    names = tuple(str(name) for name in stored["names"])
    grid = LabelGrid(stored["labels"], stored["origin"], stored["spacing"], names)
    depth = DepthImage(stored["depth"] * float(stored["depth_step"]), camera)
    unit_m = float(stored.get("unit_m", np.nan))  # files from before it was kept do not say
    truth = TruthGrid(grid, stored["kept"])
    known = np.isfinite(unit_m)
    return SampleView(str(stored["scene"]), int(stored["seed"]), depth, truth, unit_m if known else None)
