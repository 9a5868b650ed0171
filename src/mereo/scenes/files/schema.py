"""What a scene file may say: one class per block, its fields the keys, their types the rules.

Lengths and places are in the file's own unit and frame, those of its meshes; the camera's distances and ``size`` are in
scene units, the unit of datasets and weights. Angles are in degrees. ``docs/own-object.md`` explains every key.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, model_validator

from mereo.geometry.conventions import UNITS_M


def _unit_m(value: object) -> object:
    """Metres per unit, of a unit's name."""
    if isinstance(value, str) and value in UNITS_M:
        return UNITS_M[value]
    if isinstance(value, str):
        raise ValueError(f"it must be one of {', '.join(UNITS_M)}, or a number of metres per unit")
    return value


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("it must be [least, most]")
    return value


def _pointing(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("it is a direction and must have a length")
    return value


Byte = Annotated[int, Field(ge=0, le=255)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/\\\x00-\x1f]+$")]
Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Direction = Annotated[Point, AfterValidator(_pointing)]
Range = Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_ascending)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ascending)]


class Block(BaseModel):
    """A block of keys: none but its fields, and none of them changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PartLook(Block):
    """How a segment is called and shown.

    Attributes:
        name: identifies the segment in datasets, weights and every result.
        color: red, green, blue in 0..255; a colour of the palette where absent.
        nested_in: the segment around this one, whose mesh is its outer surface alone.
    """

    name: Name
    color: tuple[Byte, Byte, Byte] | None = None
    nested_in: Name | None = None


class FilePart(PartLook):
    """A segment from a mesh file of its own."""

    file: str


class ModelPart(PartLook):
    """A segment from one or more named parts of ``model``; by default the part that is called as it is."""

    parts: Annotated[list[str], Field(min_length=1)] | None = None


class Camera(Block):
    """The camera's workspace, ``scene.Workspace`` in degrees."""

    aperture: Annotated[FiniteFloat, Field(gt=0, le=360)] = 140.0
    distance: PositiveRange = (100.0, 200.0)
    axis: Direction = (0.0, 0.0, 1.0)
    roll: bool = False
    field_of_view: Annotated[FiniteFloat, Field(gt=0, lt=170)] = 35.0


class Motion(Block):
    """What all deformations have: the segments that they move, all of them where absent."""

    segments: Annotated[list[Name], Field(min_length=1)] | None = None


class Lattice(Motion):
    """Free-form deformation: random control points over the box of the segments.

    Attributes:
        cells: along x, y and z; where absent, roughly cubes, two of them along the shortest side.
        strength: largest move of a control point, as a share of what keeps the map injective.
    """

    type: Literal["lattice"]
    cells: tuple[Annotated[int, Field(ge=1, le=20)], ...] | None = Field(default=None, min_length=3, max_length=3)
    strength: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.5


class Waves(Motion):
    """A smooth random field: waves in random directions; ``strength`` bounds by how much lengths change."""

    type: Literal["waves"]
    wavelength: PositiveRange
    strength: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.3
    modes: Annotated[int, Field(ge=1, le=64)] = 4


class Bend(Motion):
    """Into a circular arc, from ``origin`` over ``length`` along ``axis``; to any side where ``toward`` is absent."""

    type: Literal["bend"]
    origin: Point
    axis: Direction
    length: Positive
    angle: Range
    toward: Direction | None = None


class Twist(Motion):
    """About ``axis``, growing from nothing at ``origin`` to ``angle`` at ``length`` beyond it."""

    type: Literal["twist"]
    origin: Point
    axis: Direction
    length: Positive
    angle: Range


class Taper(Motion):
    """Cross-sections scaled by a factor that goes from 1 at ``origin`` to ``factor`` at ``length`` beyond it."""

    type: Literal["taper"]
    origin: Point
    axis: Direction
    length: Positive
    factor: PositiveRange


class Squash(Motion):
    """Scaled by ``factor`` along an axis, a random one where absent, with the volume kept."""

    type: Literal["squash"]
    factor: PositiveRange
    axis: Direction | None = None
    center: Point | None = None


class Joint(Motion):
    """Rigid motion: a turn by ``angle`` about ``axis`` through ``pivot``, a ``slide`` along it, a ``shift`` anywhere.

    Attributes:
        shift: largest displacement to either side along x, y and z.
    """

    type: Literal["joint"]
    pivot: Point
    axis: Direction
    angle: Range = (0.0, 0.0)
    slide: Range = (0.0, 0.0)
    shift: tuple[Annotated[FiniteFloat, Field(ge=0)], ...] = Field(default=(0.0, 0.0, 0.0), min_length=3, max_length=3)


class Push(Motion):
    """An instrument at a random place of the surface.

    Attributes:
        distance: of its tip, outwards along the surface's normal or, where negative, inwards.
        tip: everything within this distance of the tip moves with it.
        reach: nothing moves beyond this one.
    """

    type: Literal["push"]
    distance: Range
    tip: Annotated[FiniteFloat, Field(ge=0)]
    reach: Positive

    @model_validator(mode="after")
    def _is_invertible(self) -> "Push":
        # the blend's slope is at most 15/8 over its width (``deformation.smooth_step``)
        steepest = 15 / 8 * max(abs(self.distance[0]), abs(self.distance[1]))
        if not steepest < 0.95 * (self.reach - self.tip):
            raise ValueError(f"space would fold over; reach must be above {self.tip + steepest / 0.95:.4g}")
        return self


Deformation = Lattice | Waves | Bend | Twist | Taper | Squash | Joint | Push


class SceneFile(Block):
    """A whole scene file. Exactly one of ``segments``, ``model`` and ``labels`` says where the segments come from.

    Attributes:
        name: identifies the scene in datasets and weights.
        units: metres per unit of the meshes.
        source: where they come from, and their licence.
        segments: a mesh file for each.
        model, parts: one file of named parts, and which of them to take; all where ``parts`` is absent.
        labels, names, cells: a label volume, which of its values are which segments, and the number of cells along the
            longest side of the grid on which their surfaces are found.
        size: length of the object's shortest side, in scene units.
        camera: its workspace.
        deformations: applied in this order; a lattice over all segments where absent.
        states, held_out: recorded states instead of deformations, and the share of frames kept for testing.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    units: Annotated[Positive, BeforeValidator(_unit_m)]
    source: str = "the user's own"
    segments: Annotated[list[FilePart], Field(min_length=1)] | None = None
    model: str | None = None
    parts: Annotated[list[ModelPart], Field(min_length=1)] | None = None
    labels: str | None = None
    names: Annotated[dict[Annotated[int, Field(ge=1)], Name], Field(min_length=1)] | None = None
    cells: Annotated[int, Field(ge=16, le=400)] = 64
    size: Positive = 20.0
    camera: Camera = Camera()
    deformations: Annotated[list[Annotated[Deformation, Field(discriminator="type")]], Field(min_length=1)] | None = (
        None
    )
    states: str | None = None
    held_out: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.1

    @model_validator(mode="after")
    def _moves_in_one_way(self) -> "SceneFile":
        if self.states is not None and self.deformations is not None:
            raise ValueError("it has both states and deformations; recorded states say how the object moves: drop one")
        return self

    @model_validator(mode="after")
    def _has_one_source(self) -> "SceneFile":
        given = [key for key in ("segments", "model", "labels") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"it has {' and '.join(given) or 'none'} of the keys segments, model and labels; it must have exactly "
                "one, which says where the segments come from"
            )
        for key, owner in (("parts", "model"), ("names", "labels")):
            if getattr(self, key) is not None and given != [owner]:
                raise ValueError(f"it has the key {key}, which belongs to {owner}, but its segments are in {given[0]}")
        if self.labels is not None and self.names is None:
            raise ValueError("it has labels but no names; names says which values of the volume are which segments")
        return self
