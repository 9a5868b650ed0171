"""State of a registration as a small JSON file: what it holds, and how it is read and written.

``fitting.registration.state`` makes it of a registration, and a registration of it.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from pydantic_core import ErrorDetails

from mereo.fitting.registration.registration import Method
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import inverse_rigid
from mereo.io.atomic_files import write_json

STATE = "state.json"
"""Name of the file in a folder of results."""

FORMAT = 1
"""Version of the file's format; others are not read."""

MOST_BYTES = 2**20
"""Size above which a file is no state: 160 coefficients take 4 kB."""

MOST_NUMBERS = 100_000
WITNESSES = 8
"""Number of material points whose places are in the file."""

SHOWN = 60
"""Characters of a wrong value that are shown."""

CURE = "give the state.json of a `mereo reconstruct`"


def _rigid(rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    T = np.array(rows)
    rotation, last = T[:3, :3], T[3].tolist()
    turns = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    if not turns or last != [0, 0, 0, 1]:
        raise ValueError("it must be a rigid transform: a rotation, a translation, and 0 0 0 1 below")
    return rows


Coefficient = Annotated[FiniteFloat, Field(ge=-1e3, le=1e3)]
Coordinate = Annotated[FiniteFloat, Field(ge=-1e12, le=1e12)]
Scale = Annotated[FiniteFloat, Field(ge=1e-9, le=1e9)]
Text = Annotated[str, Field(max_length=500)]
Point = Annotated[tuple[Coordinate, ...], Field(min_length=3, max_length=3)]
Row = Annotated[tuple[Coordinate, ...], Field(min_length=4, max_length=4)]
Pose = Annotated[tuple[Row, ...], Field(min_length=4, max_length=4), AfterValidator(_rigid)]


class Block(BaseModel):
    """Block of keys: all of its fields, none but them, and nothing is converted."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class StateDraws(Block):
    """Draws of a scene, beside their values.

    Attributes:
        seed: of what is not recorded.
        sizes: how many numbers each call of the generator draws.
        names: what each number is called, as its slider is; "" for one without.
    """

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    sizes: Annotated[tuple[Annotated[int, Field(ge=0, le=MOST_NUMBERS)], ...], Field(max_length=MOST_NUMBERS)]
    names: tuple[Text, ...]


class RegistrationState(Block):
    """State of a registration: content of ``state.json``.

    Attributes:
        format: version of the file.
        mereo: version of mereo that wrote it.
        scene, segments: the object.
        weights: how they were named.
        model: digest of their statistical model.
        method: which description of the states ``z`` belongs to.
        z: coefficients of the modes in standard deviations, or the scene's draws, standard normal.
        draws: what plays the draws; None for modes.
        T_camera_model: rigid pose of the model in the camera frame, its translation in the input's unit.
        scene_unit: length of a scene unit in the input's unit.
        unit_m: metres in the input's unit; None where that is not known.
        frame: axes of the input.
        T_camera_input: from the input's frame to the camera frame.
        unit_known, explained, accepted, seconds: as in ``Registration``.
        witness: places of a few material points in the camera frame.
    """

    format: int
    mereo: Text
    scene: Text
    segments: tuple[Text, ...]
    weights: Text
    model: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    method: Method
    z: Annotated[tuple[Coefficient, ...], Field(max_length=MOST_NUMBERS)]
    draws: StateDraws | None
    T_camera_model: Pose
    scene_unit: Scale
    unit_m: Scale | None
    frame: CloudAxes
    T_camera_input: Pose
    explained: Annotated[FiniteFloat, Field(ge=0, le=1)]
    unit_known: bool
    accepted: bool
    seconds: Annotated[FiniteFloat, Field(ge=0)]
    witness: Annotated[tuple[Point, ...], Field(min_length=WITNESSES, max_length=WITNESSES)]

    @model_validator(mode="after")
    def _fits(self) -> "RegistrationState":
        if self.format != FORMAT:
            raise ValueError(f"its format is {self.format}; this mereo reads format {FORMAT}")
        if (self.method == "draws") != (self.draws is not None):
            raise ValueError(f"its method is {self.method!r}; the block `draws` belongs to the method 'draws' alone")
        if self.draws is not None and not sum(self.draws.sizes) == len(self.draws.names) == len(self.z):
            raise ValueError("`z`, `draws.names` and the sum of `draws.sizes` must be of one length")
        return self

    @property
    def T_input_camera(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the camera frame to the input's."""
        return inverse_rigid(np.array(self.T_camera_input))


def is_state(path: Path | None) -> bool:
    """Whether a path names a state: a JSON file, or a folder with ``state.json``."""
    return path is not None and (path.suffix.lower() == ".json" or (path / STATE).is_file())


def save_state(path: str | Path, state: RegistrationState) -> None:
    """Write a state, whole or not at all."""
    write_json(path, state.model_dump())


def read_state(path: str | Path) -> RegistrationState:
    """State from its file, or from a folder of results that has one.

    Raises ``FileNotFoundError`` where there is none, and ``ValueError`` where it is no such state.
    """
    path = Path(path)
    path = path / STATE if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; `mereo reconstruct` writes it where the answer is a registered model: check the "
            "path, or reconstruct with --method modes"
        )
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"{path} has more than {MOST_BYTES // 1024} kB; the state of a registration has a few: {CURE}")
    return parse_state(content, str(path))


def parse_state(content: str | bytes, name: str) -> RegistrationState:
    """State from the content of the file ``name``; raises ``ValueError`` where it is no such state."""
    try:
        return RegistrationState.model_validate_json(content)
    except ValidationError as error:
        raise ValueError(f"{name} is no state of a registration: {said(error.errors()[0])}: {CURE}") from None


def said(problem: ErrorDetails) -> str:
    """What is wrong first, and its value."""
    place = ".".join(str(step) for step in problem["loc"])
    rule = problem["msg"].removeprefix("Value error, ").replace("Input should", "it must").replace("should", "must")
    rule = rule[:1].lower() + rule[1:]
    if problem["type"] == "json_invalid":
        return "it is not JSON"
    if not place:
        return rule
    if problem["type"] == "missing":
        return f"`{place}` is missing"
    if problem["type"] == "extra_forbidden":
        return f"{place[:SHOWN]!r} means nothing here"
    return f"`{place}` is {repr(problem['input'])[:SHOWN]}; {rule}"
