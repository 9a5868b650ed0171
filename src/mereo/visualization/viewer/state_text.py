"""States of the laboratory as text, to be copied, sent and pasted: one line of JSON, or the content of a state.json.

    {"scene": "rope", "seed": 3, "sizes": [1, 3], "shares": [0.5, ...]}   a scene's draws, in the order of its calls
    {"scene": "rope", "model": "9f...", "z": [0.3, ...]}                  coefficients of a statistical model

Shares are those of ``scenes.draw_recorder``, 0 to 1; with ``"rest": true`` the object is at rest, and they are where
the sliders stand. A ``state.json`` (``fitting.registration.state``) has the pose and the frame of a registration
too, which the laboratory does not need.
"""

import json
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat, NonNegativeInt, ValidationError, model_validator

from mereo.fitting.registration.state import (
    MOST_NUMBERS,
    Block,
    RegistrationState,
    Text,
    model_digest,
    parse_state,
    played_state,
    said,
)
from mereo.scenes.parameters import Played, played_back
from mereo.scenes.rest_pose import at_rest, is_at_rest
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

MOST_CHARACTERS = 2**20
"""Length above which a text is no state."""

DIGITS = 9
"""Decimals of numbers in the text: a slider's thousandth of a step."""

CURE = "paste the whole text that the box has shown for a state, or the content of a state.json"

Share = Annotated[FiniteFloat, Field(ge=0, le=1)]


class DrawsText(Block):
    """A state by its draws.

    Attributes:
        scene: name of the scene.
        seed: of what is not recorded.
        sizes: how many numbers each call draws.
        shares: these numbers, one call after the other.
        rest: whether the object is at rest, whatever the draws say.
    """

    scene: Text
    seed: NonNegativeInt
    sizes: Annotated[tuple[NonNegativeInt, ...], Field(max_length=MOST_NUMBERS)]
    shares: Annotated[tuple[Share, ...], Field(max_length=MOST_NUMBERS)]
    rest: bool = False

    @model_validator(mode="after")
    def _fits(self) -> "DrawsText":
        if sum(self.sizes) != len(self.shares):
            raise ValueError(f"it has {len(self.shares)} `shares`, but its `sizes` add up to {sum(self.sizes)}")
        return self


class ModesText(Block):
    """A state by the coefficients of a statistical model.

    Attributes:
        scene: name of the scene.
        model: digest of the statistical model.
        z: coefficients in standard deviations.
    """

    scene: Text
    model: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    z: Annotated[tuple[FiniteFloat, ...], Field(max_length=MOST_NUMBERS)]


def of_draws(scene: Scene, shape: Played) -> str:
    """Text of a state of draws."""
    sizes = [len(call.shares) for call in shape.calls]
    shares = [round(float(share), DIGITS) for call in shape.calls for share in call.shares]
    rest = {"rest": True} if is_at_rest(shape) else {}
    return json.dumps({"scene": scene.name, "seed": shape.seed, "sizes": sizes, "shares": shares, **rest})


def to_draws(scene: Scene, text: str) -> Played:
    """State that a scene plays with the draws of a text.

    Raises ``ValueError`` for a text that is no state, is one of modes or of another scene, or is refused by the scene.
    """
    found = _read(text)
    if isinstance(found, ModesText) or (isinstance(found, RegistrationState) and found.draws is None):
        raise ValueError(
            f"the text is a state of the modes of {found.scene!r}, and the sliders here are the scene's draws: save it "
            "as a file and start the laboratory with it, mereo view --scene NAME --state FILE"
        )
    _check_scene(found.scene, scene.name)
    if isinstance(found, RegistrationState):
        return played_state(found, scene)
    shares = np.split(np.array(found.shares), np.cumsum(found.sizes)[:-1])
    played = played_back(scene, found.seed, shares, CURE)
    return at_rest(scene, played) if found.rest else played


def of_modes(scene: str, model: StatisticalModel, z: Float[np.ndarray, " k"]) -> str:
    """Text of a state of modes."""
    return json.dumps({"scene": scene, "model": model_digest(model), "z": np.round(z, DIGITS).tolist()})


def to_modes(scene: str, model: StatisticalModel, text: str) -> Float[np.ndarray, " k"]:
    """Coefficients that a text says.

    Raises ``ValueError`` for a text that is no state, is one of draws, of another scene or another statistical model.
    """
    found = _read(text)
    if isinstance(found, DrawsText) or (isinstance(found, RegistrationState) and found.draws is not None):
        raise ValueError(
            f"the text is a state of the draws of {found.scene!r}, and the sliders here are modes: start the "
            "laboratory without --state, and paste it there"
        )
    _check_scene(found.scene, scene)
    if isinstance(found, RegistrationState) and found.method == "rest":
        return model.rest_z
    if found.model != model_digest(model) or len(found.z) != model.count:
        raise ValueError(
            "the text is a state of another statistical model; its numbers mean nothing here: start the laboratory "
            "with those --weights"
        )
    return np.array(found.z)


def _check_scene(named: str, shown: str) -> None:
    if named != shown:
        raise ValueError(f"the text is a state of the scene {named!r}, and {shown!r} is shown: open that scene")


def _read(text: str) -> DrawsText | ModesText | RegistrationState:
    """What a text says, by the keys that only one kind of state has."""
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"the text has {len(text):,} characters, and a state a few thousand: {CURE}")
    try:
        keys = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError(f"the text is no state: it is not JSON: {CURE}") from None
    if isinstance(keys, dict) and "format" in keys:
        return parse_state(text, "the text")
    kind = ModesText if isinstance(keys, dict) and "z" in keys else DrawsText
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(f"the text is no state: {said(error.errors()[0])}: {CURE}") from None
