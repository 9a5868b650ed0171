"""What the sliders of the laboratory move: a scene's own draws, or the modes of its statistical model.

shape -parameters-> sliders -moved-> another shape -state-> State (mesh, deformations)
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import DrawName
from mereo.fitting.registration.registration import SegmentMotion
from mereo.scenes.parameters import Parameter, Played, parameters, random_state, set_value
from mereo.scenes.rest_pose import at_rest
from mereo.scenes.scene import Scene, State
from mereo.scenes.statistical_model import StatisticalModel
from mereo.scenes.walks import blend, smooth_round
from mereo.visualization.viewer import state_text

Shape = TypeVar("Shape")

SLIDERS = 10
"""Modes that get a slider, the largest first; the others stay where they are."""

REACH = 3.0
"""Standard deviations to either side that a slider of a mode covers at least."""


@runtime_checkable
class Freedom(Protocol[Shape]):
    """Way to describe the states of an object by numbers that sliders may move."""

    def first(self, seed: int) -> Shape:
        """The shape that is shown first; of a seed where none was chosen."""

    def random(self, seed: int) -> Shape:
        """A random shape."""

    def parameters(self, shape: Shape) -> tuple[Parameter, ...]:
        """What sliders show."""

    def moved(self, shape: Shape, parameter: Parameter, value: float) -> Shape:
        """The shape with one slider elsewhere; raises ``parameters.Refused`` where that is not allowed."""

    def state(self, shape: Shape) -> State:
        """The segments of the shape, in the scene's frame."""

    def rest(self, shape: Shape) -> Shape:
        """The shape nearest to the object at rest, coming from another one."""

    def walk(self, shape: Shape, seed: int, count: int) -> Iterator[Shape]:
        """Shapes of a smooth walk of ``count`` steps at most, which ends where it began."""

    def text(self, shape: Shape) -> str:
        """The shape as text, for ``read``."""

    def read(self, text: str) -> Shape:
        """The shape that a text says, its own or a ``state.json``; raises ``ValueError`` where it says none."""


@dataclass(frozen=True, eq=False)
class DrawnShapes:
    """Freedom of a scene's own draws. Satisfies ``Freedom``.

    Attributes:
        scene: what is played.
        start: what is shown first.
    """

    scene: Scene
    start: Played | None = None

    def first(self, seed: int) -> Played:
        """The chosen start, or the random state of a seed."""
        return self.random(seed) if self.start is None else self.start

    def random(self, seed: int) -> Played:
        """Random state of a seed."""
        return random_state(self.scene, seed)

    def parameters(self, shape: Played) -> tuple[Parameter, ...]:
        """One slider for each number that the scene draws."""
        return parameters(shape)

    def moved(self, shape: Played, parameter: Parameter, value: float) -> Played:
        """The state with one draw elsewhere; a slider of a part that has just gone has nothing left to move."""
        return set_value(self.scene, shape, parameter, value) if parameter.key in shape.keys else shape

    def state(self, shape: Played) -> State:
        """The state that the scene has played."""
        return self.scene.deform(shape.deformations)

    def rest(self, shape: Played) -> Played:
        """The object at rest; sliders stay where they are, because no draws of most scenes lead there."""
        return at_rest(self.scene, shape)

    def walk(self, shape: Played, seed: int, count: int) -> Iterator[Played]:
        """Round of all smooth draws, without states that the scene refuses."""
        return smooth_round(self.scene, shape, seed, count)

    def text(self, shape: Played) -> str:
        """The draws as shares, in the order of the calls."""
        return state_text.of_draws(self.scene, shape)

    def read(self, text: str) -> Played:
        """The state that the scene plays with the draws of a text."""
        return state_text.to_draws(self.scene, text)


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Freedom of a statistical model's modes. Satisfies ``Freedom``.

    Attributes:
        scene: name of the object's.
        model: whose modes are moved.
        start: coefficients that are shown first.
    """

    scene: str
    model: StatisticalModel
    start: Float[np.ndarray, " k"]

    def first(self, seed: int) -> Float[np.ndarray, " k"]:
        """The chosen start."""
        return self.start

    def random(self, seed: int) -> Float[np.ndarray, " k"]:
        """Coefficients of a random state of those that the model was built from."""
        library = self.model.library
        return library[np.random.default_rng(seed).integers(len(library))].astype(np.float64)

    def parameters(self, shape: Float[np.ndarray, " k"]) -> tuple[Parameter, ...]:
        """One slider for each of the largest modes, in standard deviations."""
        return tuple(_mode_slider(number, float(value)) for number, value in enumerate(shape[:SLIDERS]))

    def moved(self, shape: Float[np.ndarray, " k"], parameter: Parameter, value: float) -> Float[np.ndarray, " k"]:
        """The coefficients with one of them elsewhere."""
        result = shape.copy()
        result[parameter.key[1]] = value
        return result

    def state(self, shape: Float[np.ndarray, " k"]) -> State:
        """The model's mesh, which its material points move."""
        material = self.model.material(shape)
        motions = tuple(SegmentMotion(anchors, material) for anchors in self.model.rest_anchors)
        return State(self.model.mesh(material), motions)

    def rest(self, shape: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Coefficients nearest to the rest pose."""
        return self.model.rest_z

    def walk(self, shape: Float[np.ndarray, " k"], seed: int, count: int) -> Iterator[Float[np.ndarray, " k"]]:
        """Straight way to a random state and back: a round as of draws would stretch the object on its far side."""
        other = self.random(seed)
        return (shape + share * (other - shape) for share in blend(count))

    def text(self, shape: Float[np.ndarray, " k"]) -> str:
        """The coefficients, and whose."""
        return state_text.of_modes(self.scene, self.model, shape)

    def read(self, text: str) -> Float[np.ndarray, " k"]:
        """The coefficients of a text that belong to this model."""
        return state_text.to_modes(self.scene, self.model, text)


def _mode_slider(number: int, value: float) -> Parameter:
    name = f"mode {number + 1}"
    reach = max(REACH, float(np.ceil(abs(value))))
    return Parameter((((), DrawName(("modes",), name)), number), None, "modes", name, "σ", -reach, reach, value)
