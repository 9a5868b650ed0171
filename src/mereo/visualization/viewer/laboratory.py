"""Laboratory of a scene: any state, seen by any camera of its workspace, reconstructed and compared with the truth.

    shape (see ``freedom``), CameraPlace, Sensing -look-> Sight -rebuild-> Trial (default answer, scores)

No page is needed for it; ``mereo.visualization.viewer`` puts sliders to it.
"""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.evaluation.cases import grid_confusion
from mereo.evaluation.ground_truth import truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.scoring import check_names, predict_grid
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.solids import Solids, label_grid
from mereo.geometry.transforms import inverse_rigid
from mereo.models.trained import Trained
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import Reconstruction, segment_names
from mereo.scenes.scene import Scene
from mereo.synthesis.examples import View
from mereo.visualization.viewer.freedom import DrawnShapes, Freedom
from mereo.visualization.viewer.probe import source_of
from mereo.visualization.viewer.sight import Sensing, Sight, see

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
    """Answer to a view, and how good it is.

    Attributes:
        answer: in the camera frame, as `mereo reconstruct` gives it.
        source: where it comes from, in a phrase.
        scores: against the truth, on ``cells`` ** 3 cells.
        cells: the paper takes 100; fewer are faster and a little off.
        seconds: of the reconstruction.
    """

    answer: Answer
    source: str
    scores: Scores
    cells: int
    seconds: float

    @property
    def reconstruction(self) -> Reconstruction:
        """Segments that were found."""
        return self.answer.reconstruction


class QuickRegistrar(Registrar):
    """Registrar for frames that change while they are looked at: it fits the modes alone."""

    @property
    def asks_search(self) -> bool:
        """Whether a search is asked too; it takes seconds."""
        return False

    def finish(self, fitted: ModesFit) -> Registration:
        """The answer of the modes."""
        return fitted.registration()


@dataclass(frozen=True, eq=False)
class Laboratory:
    """Scene, and the model that is to reconstruct it; without one there is only the view.

    Attributes:
        scene: the object, and where its camera may be.
        model: the weights.
        shapes: what the sliders move; the scene's own draws by default.

    Raises ``ValueError`` for a model of another object.
    """

    scene: Scene
    model: Trained | None
    shapes: Freedom[Any] | None = None

    def __post_init__(self) -> None:
        if self.model is not None:
            check_names(self.model, self.scene.rest.names)

    @cached_property
    def freedom(self) -> Freedom[Any]:
        """What the sliders move."""
        return DrawnShapes(self.scene) if self.shapes is None else self.shapes

    @cached_property
    def registrar(self) -> Registrar | None:
        """Registrar of the default answer, set up once."""
        return None if self.model is None else registrar_for(self.model, "auto", self.scene)

    @cached_property
    def quick_registrar(self) -> Registrar | None:
        """The same for while a slider moves."""
        full = self.registrar
        return None if full is None else QuickRegistrar(full.network, full.model, full.method, full.given)

    def camera(self, size: int) -> Camera:
        """Virtual depth camera of the scene's workspace, of so many pixels a side."""
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

    def look(self, shape: Any, place: CameraPlace, sensing: Sensing = Sensing()) -> Sight:  # noqa: B008 (frozen)
        """Shape of ``freedom`` as a camera at this place gives it.

        Raises ``ValueError`` where fewer than ``MIN_POINTS`` points of the object are seen.
        """
        state = self.freedom.state(shape)
        T_world_camera = self.pose(state.mesh.bounds.mean(axis=0), place)
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        seen, hidden = see(Solids(mesh), self.camera(sensing.image_size), sensing)
        if seen.object_points < MIN_POINTS:
            raise ValueError(
                f"the camera sees {seen.object_points} points of the object; at least {MIN_POINTS} are needed: move "
                "the camera, or give it a larger image"
            )
        return Sight(mesh, seen.image, T_world_camera, state.deformations, hidden)

    def answer(self, view: View, resolution: int = 128, quick: bool = False) -> Answer:
        """Answer to what is seen, as `mereo reconstruct` gives it.

        ``quick`` never fits the scene's own draws, which takes seconds. Raises ``ValueError`` without a model, and
        where the model finds nothing.
        """
        if self.model is None:
            raise ValueError("there are no weights; a reconstruction needs them: name them with --weights")
        registrar = self.quick_registrar if quick else self.registrar
        seen = observe(view.depth.to_points(), unit_m=self.scene.unit_m)
        return answer_frame(seen, self.model, registrar, resolution=resolution)

    def rebuild(self, view: View, resolution: int, cells: int, quick: bool = False) -> Trial:
        """Answer to what is seen, scored on a grid of ``cells`` cells a side; raises as ``answer`` does."""
        start = time.perf_counter()
        answer = self.answer(view, resolution, quick)
        reconstruction = answer.reconstruction
        seconds = time.perf_counter() - start
        assert self.model is not None
        truth = truth_grid(view.mesh, cells)
        if answer.taken:
            predicted = label_grid(reconstruction.surfaces, *truth.grid.axes())
        else:
            assert reconstruction.code is not None
            predicted = predict_grid(self.model, reconstruction.code, truth)
        confusion = grid_confusion(truth, predicted, len(segment_names(self.model)[0]))
        scores = intersection_over_union(confusion, self.model.segmented)
        return Trial(answer, source_of(answer), scores, cells, seconds)


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
