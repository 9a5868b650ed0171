"""Laboratory of a scene: any state, seen by any camera of its workspace, reconstructed and compared with the truth.

    Played (see ``mereo.scenes.parameters``), CameraPlace -look-> View -rebuild-> Trial (reconstruction, scores)

No page is needed for it; ``mereo.visualization.viewer`` puts sliders to it.
"""

import time
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from mereo.evaluation.metrics import Scores
from mereo.evaluation.scoring import check_names, grid_scores
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.models.model import Model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct
from mereo.scenes.parameters import Played
from mereo.scenes.scene import Scene
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.depth_sensor import observe
from mereo.synthesis.examples import View

NEAR: tuple[int, int, int] = (255, 236, 190)
FAR: tuple[int, int, int] = (38, 30, 84)
NOTHING: tuple[int, int, int] = (16, 19, 26)
"""Colours of depth images: the nearest and the farthest measured point, and where nothing was measured."""


@dataclass(frozen=True)
class CameraPlace:
    """Place of the camera in the terms of the scene's ``Workspace``.

    Attributes:
        tilt_rad: away from the workspace's axis, 0 to half its aperture.
        azimuth_rad: around the axis.
        distance: from the object's middle, in scene units.
        roll_rad: about the viewing axis.
    """

    tilt_rad: float
    azimuth_rad: float
    distance: float
    roll_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Trial:
    """Reconstruction of a view, and how good it is.

    Attributes:
        result: in the camera frame.
        scores: against the truth, on ``cells`` ** 3 cells.
        cells: the paper takes 100; fewer are faster and a little off.
        seconds: of the reconstruction.
    """

    result: Reconstruction
    scores: Scores
    cells: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Laboratory:
    """Scene, and the model that is to reconstruct it; without one there is only the view.

    Raises ``ValueError`` for a model of another object.
    """

    scene: Scene
    model: Model | None
    settings: GenerateConfig = field(default_factory=GenerateConfig)

    def __post_init__(self) -> None:
        if self.model is not None:
            check_names(self.model, self.scene.rest.names)

    @property
    def camera(self) -> Camera:
        """Virtual depth camera of the scene's workspace."""
        size = self.settings.image_size
        return Camera.from_fov(size, size, self.scene.workspace.fov_rad)

    def first_place(self) -> CameraPlace:
        """First place of the camera: oblique, in the middle of the allowed distances."""
        near, far = self.scene.workspace.distance
        tilt = min(np.deg2rad(35.0), self.most_tilt_rad)
        return CameraPlace(float(tilt), float(np.deg2rad(40.0)), (near + far) / 2)

    @property
    def most_tilt_rad(self) -> float:
        """Largest angle between the camera's direction and the workspace's axis."""
        return float(min(self.scene.workspace.aperture_rad / 2, np.pi))

    def pose(self, target: Float[np.ndarray, "3"], place: CameraPlace) -> Float[np.ndarray, "4 4"]:
        """Pose ``T_world_camera`` of a camera at a place, aimed at ``target``."""
        cosine = float(np.cos(place.tilt_rad))
        return self.scene.workspace.pose(target, cosine, place.azimuth_rad, place.distance, place.roll_rad)

    def look(self, played: Played, place: CameraPlace) -> View:
        """State as the camera sees it; its noise is the same every time, so that pictures do not flicker.

        Raises ``ValueError`` where fewer than ``MIN_POINTS`` points of the object are seen.
        """
        state = self.scene.deform(played.deformations)
        T_world_camera = self.pose(state.mesh.bounds.mean(axis=0), place)
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        rng = np.random.default_rng(0)
        seen = observe(Solids(mesh), self.camera, self.settings.noise_std, self.settings.sensor, rng)
        if seen.object_points < MIN_POINTS:
            raise ValueError(
                f"the camera sees {seen.object_points} points of the object; at least {MIN_POINTS} are needed: move "
                "the camera"
            )
        return View(mesh, seen.image, T_world_camera, state.deformations)

    def rebuild(self, view: View, resolution: int, cells: int) -> Trial:
        """Reconstruct what is seen, and score it on a grid of ``cells`` cells a side.

        Raises ``ValueError`` without a model, and where the model finds nothing.
        """
        if self.model is None:
            raise ValueError("there are no weights; a reconstruction needs them: name them with --weights")
        cloud = view.depth.to_points()
        start = time.perf_counter()
        result = reconstruct(cloud, self.model, resolution)
        seconds = time.perf_counter() - start
        return Trial(result, grid_scores(self.model, result.code, view.mesh, cells), cells, seconds)


def depth_picture(depth: DepthImage, factor: int = 1) -> UInt8[np.ndarray, "h w 3"]:
    """Picture of a depth image for the eye: near is light, far is dark, each pixel ``factor`` pixels wide."""
    valid, values = depth.valid, depth.depth
    shares = np.zeros_like(values)
    if valid.any():
        low, high = values[valid].min(), values[valid].max()
        shares = np.where(valid, (values - low) / max(high - low, 1e-12), 0.0)
    near, far = np.array(NEAR, dtype=float), np.array(FAR, dtype=float)
    picture = np.where(valid[..., None], near + shares[..., None] * (far - near), np.array(NOTHING, dtype=float))
    return picture.round().astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)
