"""Views that weights are calibrated with: the object as cameras see it, and what is not it.

scene -own_views-> CalibrationView (the object in states that were learned, clean and noisy)
      -strange_frames-> StrangeFrame (other objects, planes and heaps; frames_beyond: states beyond the scene's)
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from mereo.evaluation.scoring import true_material
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.farther_states import with_farther_states
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo.synthesis.strangers import stranger_cloud

CAMERAS: tuple[Sensor, ...] = ("paper", "structured-light", "paper", "time-of-flight")
"""Cameras of the views, in turn: half of them clean."""

FARTHER = 1.5
"""Factor of the draws of states that were not learned, in their bounds."""

LIVERS = ("liver", "tumor", "liver-simulated")
"""Scenes of one liver, of which one is as good as another to be told from other objects."""

OF_OTHERS, OF_PLANES, OF_HEAPS, OF_FARTHER = range(1, 5)
"""Seeds of what is strange, beyond that of the views; each has a stream of its own."""


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The object in a random state, with its truth, as a camera sees it.

    Attributes:
        mesh: the true segments, camera frame, scene units.
        seen: the cloud, in the same.
        camera: whose errors it has.
        scene_unit: length of a scene unit in the cloud's unit, 1; None in every other pair of views, which have to
            find it.
        material: true places of a statistical model's material points, or of the first of them.
    """

    mesh: SegmentedMesh
    seen: PointCloud
    camera: Sensor
    scene_unit: float | None
    material: Callable[[StatisticalModel], Float[np.ndarray, "m 3"]]

    @property
    def clean(self) -> bool:
        """Whether the camera is the paper's."""
        return self.camera == "paper"


@dataclass(frozen=True, eq=False)
class StrangeFrame:
    """A frame that does not show the object in a state that was learned.

    Attributes:
        kind: "other object", "plane or clutter", or "state beyond".
        cloud: what is seen, about as large as the object.
        name: of what is seen.
    """

    kind: str
    cloud: PointCloud
    name: str = ""


def own_views(scene: Scene, count: int, seed: int) -> Iterator[CalibrationView]:
    """Views of a scene; view i is made from (seed, i) alone."""
    for index in range(count):
        scene_unit = 1.0 if index // len(CAMERAS) % 2 == 0 else None
        yield _own_view(scene, seed, index, CAMERAS[index % len(CAMERAS)], scene_unit)


def clean_views(scene: Scene, count: int, seed: int, first: int) -> Iterator[CalibrationView]:
    """Views of a scene by the paper's camera, with the unit known, from view ``first`` on."""
    for index in range(first, first + count):
        yield _own_view(scene, seed, index, "paper", 1.0)


def _own_view(scene: Scene, seed: int, index: int, camera: Sensor, scene_unit: float | None) -> CalibrationView:
    view = sample_view(scene.for_seed(seed), GenerateConfig(sensor=SENSORS[camera]), example_rng(seed, index))
    return CalibrationView(view.mesh, view.depth.to_points(), camera, scene_unit, partial(true_material, view))


def strange_frames(scene: Scene, others: Sequence[Scene], each: int, seed: int) -> Iterator[StrangeFrame]:
    """Frames of every other object (``other_objects``), and ``4 * each`` of planes and of heaps."""
    for other in others:
        for index in range(each):
            yield StrangeFrame("other object", _seen(other, seed + OF_OTHERS, index), other.name)
    settings = GenerateConfig()
    for index in range(4 * each):
        plane, heap = (example_rng(seed + offset, index) for offset in (OF_PLANES, OF_HEAPS))
        yield StrangeFrame("plane or clutter", stranger_cloud(scene, "plane", settings, plane))
        yield StrangeFrame("plane or clutter", stranger_cloud(scene, "clutter", settings, heap))


def frames_beyond(scene: Scene, count: int, seed: int, factor: float = FARTHER) -> Iterator[StrangeFrame]:
    """Frames of the object in states whose draws are all ``factor`` times as far from their middle as their bounds.

    None of a scene that refuses such states.
    """
    with suppress(ValueError):
        for index in range(count):
            yield StrangeFrame("state beyond", _seen(with_farther_states(scene, factor), seed + OF_FARTHER, index))


def other_objects(scene: Scene) -> list[Scene]:
    """Built-in scenes of other objects than this one, whose meshes are here."""
    same = LIVERS if scene.name in LIVERS else (scene.name,)
    found = []
    for name in SCENES:
        with suppress(AssetUnavailable):
            if name not in (*same, *LIVERS[1:]):
                found.append(load_scene(name))
    return found


def _seen(scene: Scene, seed: int, index: int) -> PointCloud:
    return sample_view(scene, GenerateConfig(), example_rng(seed, index)).depth.to_points()
