"""What the sliders of the laboratory move: a scene's own draws, or the modes of its statistical model.

shape -parameters-> sliders -moved-> another shape -state-> State (mesh, deformations)
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import DrawName
from mereo.fitting.registration import SegmentMotion
from mereo.scenes.parameters import Parameter, Played, parameters, random_state, set_value
from mereo.scenes.scene import Scene, State
from mereo.scenes.statistical_model import StatisticalModel

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


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Freedom of a statistical model's modes. Satisfies ``Freedom``.

    Attributes:
        model: whose modes are moved.
        start: coefficients that are shown first.
    """

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


def _mode_slider(number: int, value: float) -> Parameter:
    name = f"mode {number + 1}"
    reach = max(REACH, float(np.ceil(abs(value))))
    return Parameter((((), DrawName(("modes",), name)), number), None, "modes", name, "σ", -reach, reach, value)
