"""Objects that can be found in frames, with what is needed for it loaded once.

weights, scene -load_object-> Object -registrar-> Registrar of a method
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

from mereo.api.words import python_words
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.register import Registrar, registrar_for, statistical_model_of
from mereo.learning.object_files import SCENE
from mereo.models.config import Device, InferenceConfig, Precision
from mereo.models.model import Model
from mereo.models.weights import load_for
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene


@dataclass(frozen=True, eq=False, repr=False)
class Object:
    """Object that can be found in frames.

    Attributes:
        model: its network, with the statistical model of its states where the weights carry one.
        scene: how it deforms, where that is not the built-in scene that the weights were trained on.
    """

    model: Model
    scene: Scene | None = None
    _registrars: dict[str, Registrar | None] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Object({self.model.name!r}: {', '.join(self.model.names)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the segments, in the order of their labels."""
        return self.model.names

    def registrar(self, method: AnswerMethod = "auto") -> Registrar | None:
        """Registrar of the object's deformation model for a method, set up once; None where the network alone answers.

        Raises ``ValueError`` for a method that there is none of, and where it cannot be had of this object.
        """
        if method not in get_args(AnswerMethod):
            known = ", ".join(get_args(AnswerMethod))
            raise ValueError(f"the method is {method!r}; it must be one of {known}: correct the spelling")
        if method not in self._registrars:
            self._registrars[method] = registrar_for(self.model, method, self.scene)
        return self._registrars[method]

    def with_deformation_model(self) -> "Object":
        """The same with a statistical model; weights that carry none get that of their built-in scene, in seconds.

        Raises ``ValueError`` where it cannot be had.
        """
        return Object(replace(self.model, statistical_model=statistical_model_of(self.model)), self.scene)

    def asking(self, model: Model) -> "Object":
        """The same with the same weights on another device; registrars that are set up stay so."""
        moved = {name: None if one is None else one.asking(model) for name, one in self._registrars.items()}
        return Object(model, self.scene, moved)


@python_words()
def load_object(
    weights: str | Path | Model,
    scene: Scene | str | Path | None = None,
    *,
    device: Device = "auto",
    precision: Precision = "auto",
) -> Object:
    """Load an object that can be found in frames.

    Args:
        weights: a shipped name, a file of weights, or the folder that ``mereo learn`` has written, whose scene is taken
            too; or weights that are loaded already.
        scene: the object's scene, its name or its file, where it is not the built-in one of the weights.
        device: where the network computes; "auto" takes a CUDA device where there is one.
        precision: of its products; "float32" is exact.

    Raises ``FileNotFoundError`` where there is no such file or name, and ``ValueError`` for other files.
    """
    if not isinstance(weights, Model):
        own = Path(weights) / SCENE
        scene = own if scene is None and own.is_file() else scene
        weights = load_for(weights, InferenceConfig(device, precision))
    return Object(weights, load_scene(str(scene)) if isinstance(scene, str | Path) else scene)


def object_of(given: Object | Model | str | Path) -> Object:
    """Object of whatever a caller has of it."""
    return given if isinstance(given, Object) else load_object(given)
