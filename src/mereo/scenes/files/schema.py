"""What a scene file may say: one class per block, its fields the keys, their types the rules.

Lengths and places are in the file's own unit and frame, those of its meshes; the camera's distances and ``size`` are in
scene units, the unit of datasets and weights. Angles are in degrees. ``docs/own-object.md`` explains every key.
"""

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, FiniteFloat, model_validator

from mereo.geometry.conventions import UNITS_M
from mereo.scenes.files.deformation_blocks import Block, Byte, Deformations, Direction, Name, Positive, PositiveRange
from mereo.scenes.scene import Workspace

# --- schema -----------------------------------------------------------------------------------------------------------


def _unit_m(value: object) -> object:
    """Metres per unit, of a unit's name."""
    if isinstance(value, str) and value in UNITS_M:
        return UNITS_M[value]
    if isinstance(value, str):
        raise ValueError(f"it must be one of {', '.join(UNITS_M)}, or a number of metres per unit")
    return value


class PartLook(Block):
    """Name and look of a segment.

    Attributes:
        name: identifies the segment in datasets, weights and every result.
        color: red, green, blue in 0..255; a colour of the palette where absent.
        nested_in: the segment around this one, whose mesh is its outer surface alone.
    """

    name: Name
    color: tuple[Byte, Byte, Byte] | None = None
    nested_in: Name | None = None


class FilePart(PartLook):
    """Segment from a mesh file of its own."""

    file: str


class ModelPart(PartLook):
    """Segment from one or more named parts of ``model``; by default the part that is called as it is."""

    parts: Annotated[list[str], Field(min_length=1)] | None = None


class CameraBlock(Block):
    """Workspace of the camera, ``scenes.scene.Workspace`` in degrees."""

    aperture: Annotated[FiniteFloat, Field(gt=0, le=360)] = 140.0
    distance: PositiveRange = (100.0, 200.0)
    axis: Direction = (0.0, 0.0, 1.0)
    roll: bool = False
    field_of_view: Annotated[FiniteFloat, Field(gt=0, lt=170)] = 35.0

    def workspace(self) -> Workspace:
        """Workspace that this block describes, angles in radians."""
        return Workspace(
            aperture_rad=float(np.deg2rad(self.aperture)),
            distance=self.distance,
            axis=self.axis,
            any_roll=self.roll,
            fov_rad=float(np.deg2rad(self.field_of_view)),
        )


class SceneFile(Block):
    """Content of a scene file. Exactly one of ``segments``, ``model``, ``labels`` says where the segments come from.

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
    camera: CameraBlock = CameraBlock()
    deformations: Deformations | None = None
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
