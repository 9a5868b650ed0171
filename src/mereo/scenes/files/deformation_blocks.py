"""Deformations that a scene file may list: one block each, which says its keys and makes the sampler of its maps.

Places and lengths of a block are in the file's frame and unit, angles in degrees; those of its sampler are in scene
units and radians.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from jaxtyping import Int
from numpy.linalg import norm
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    field_validator,
    model_serializer,
    model_validator,
)
from scipy.spatial import cKDTree

from mereo.deformation import samplers
from mereo.deformation.elastic import ElasticSampler, ElasticSolid, Material, build_lattice
from mereo.deformation.maps import unit
from mereo.deformation.samplers import DeformationSampler
from mereo.geometry.conventions import UNITS_M, Texts, Triple
from mereo.geometry.conventions import Range as Limits
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Corners, Indices, Normalizer, Points, Values, Vector, checked_pose, longest_side
from mereo.io.config import RobotMeshes
from mereo.io.point_arrays import model_points
from mereo.io.readers import read_points
from mereo.io.simulation_states import read_tetrahedra
from mereo.io.yaml_document import similar
from mereo.scenes.recorded_states import tetrahedra_around
from mereo.scenes.scene import Workspace

# --- fields -----------------------------------------------------------------------------------------------------------

# Kinds of values that a scene file may hold, and their rules: places, directions, ranges, names, colours.


def _ascending(value: Limits) -> Limits:
    if value[0] > value[1]:
        raise ValueError("it must be [least, most]")
    return value


def _pointing(value: Triple) -> Triple:
    if not any(value):
        raise ValueError("it is a direction and must have a length")
    return value


def _placing(value: list[list[float]]) -> list[list[float]]:
    try:
        checked_pose(value)
    except ValueError:
        raise ValueError("it must be 4 x 4 numbers, a rotation and a translation above 0 0 0 1") from None
    return value


MOST = 1e12
"""Largest number of a scene file: products of a few remain finite."""

Item = TypeVar("Item")
NonEmpty = Annotated[list[Item], Field(min_length=1)]
ProperShare = Annotated[FiniteFloat, Field(ge=0, lt=1)]

Number = Annotated[FiniteFloat, Field(ge=-MOST, le=MOST)]
Byte = Annotated[int, Field(ge=0, le=255)]
FileName = Annotated[str, Field(min_length=1)]

Positive = Annotated[FiniteFloat, Field(gt=0, le=MOST)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/\\\x00-\x1f]+$")]
Point = tuple[Number, Number, Number]
Direction = Annotated[Point, AfterValidator(_pointing)]
Range = Annotated[tuple[Number, Number], AfterValidator(_ascending)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ascending)]


class Block(BaseModel):
    """Block of keys: none but its fields, and none of them changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# --- deformation blocks -----------------------------------------------------------------------------------------------


class Misfit(ValueError):
    """Error of a value that does not fit the object which it is to move.

    Attributes:
        key: of the block, whose value it is.
    """

    def __init__(self, key: str, message: str) -> None:
        """Error with a ``message`` of value, rule and cure."""
        super().__init__(message)
        self.key = key


@dataclass(frozen=True, eq=False)
class Target:
    """Object of one deformation, and the way from the file's frame to the scene's.

    Attributes:
        moved: the segments that it moves, at rest in scene units.
        whole: the joint box of all segments, in scene units.
        placement: from the file's frame and unit to the scene's.
        folder: of the file, where the names of other files start.
    """

    moved: SegmentedMesh
    whole: Corners
    placement: Normalizer
    folder: Path = Path()

    @property
    def unit(self) -> float:
        """Scene units per unit of the file, by which its lengths are multiplied."""
        return self.placement.scale

    def point(self, place: Point) -> Vector:
        """Place of the file in the scene's frame."""
        return self.placement.apply(np.array(place))


class DeformationBlock(Block, ABC):
    """Deformation of a scene file; all have ``segments``, those that it moves, all of them where absent."""

    segments: NonEmpty[Name] | None = None

    @abstractmethod
    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of this block's maps for an object. Raises ``Misfit`` where a value does not fit it."""


MOST_CELLS = 20
"""Of a lattice along each side."""

Cells = Annotated[int, Field(ge=1, le=MOST_CELLS)]


class LatticeBlock(DeformationBlock):
    """Free-form deformation: random control points over the box of the segments.

    Attributes:
        cells: along x, y and z; where absent, roughly cubes, two of them along the shortest side.
        spacing: of control points that form cubes, instead of ``cells``: the box is enlarged to a multiple of it, so
            that a thin object moves across as far as along.
        strength: largest move of a control point, as a share of what keeps the map injective.
    """

    type: Literal["lattice"]
    cells: tuple[Cells, Cells, Cells] | None = None
    spacing: Positive | None = None
    strength: ProperShare = 0.5

    @model_validator(mode="after")
    def _has_single_grid(self) -> "LatticeBlock":
        if self.cells is not None and self.spacing is not None:
            raise ValueError("it has both cells and spacing; one of them says where the control points are: drop one")
        return self

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of lattices over the box of what is moved; ``Misfit`` where ``spacing`` is too small for it."""
        bounds = target.moved.bounds
        if self.spacing is None:
            return samplers.LatticeSampler(bounds, self.cells or samplers.default_cells(bounds), self.strength)
        longest = longest_side(bounds) / target.unit
        if longest > MOST_CELLS * self.spacing:
            raise Misfit(
                "spacing",
                f"`spacing` is {self.spacing:g}, and the object is {longest:.4g} long; it takes at most {MOST_CELLS} "
                f"cells along a side: make it {longest / MOST_CELLS:.3g} or more",
            )
        return samplers.LatticeSampler(*samplers.cubic_cells(bounds, self.spacing * target.unit), self.strength)


class WavesBlock(DeformationBlock):
    """Smooth random field: waves in random directions; ``strength`` bounds by how much lengths change."""

    type: Literal["waves"]
    wavelength: PositiveRange
    strength: ProperShare = 0.3
    modes: Annotated[int, Field(ge=1, le=64)] = 4

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of waves, their lengths in scene units."""
        return samplers.WavesSampler(_lengths(self.wavelength, target), self.strength, self.modes)


class BendBlock(DeformationBlock):
    """Bend into a circular arc, from ``origin`` over ``length`` along ``axis``, ``toward`` a side or to any."""

    type: Literal["bend"]
    origin: Point
    axis: Direction
    length: Positive
    angle: Range
    toward: Direction | None = None

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of bends; ``Misfit`` where ``toward`` is along the axis, or the largest one would fold space over."""
        origin = target.point(self.origin)
        axis = np.array(self.axis)
        length = self.length * target.unit
        toward = None if self.toward is None else np.array(self.toward)
        if toward is not None and norm(np.cross(toward, axis)) < 1e-9 * norm(toward):
            raise Misfit("toward", f"`toward` is {list(self.toward or ())}, along the axis; it must point away from it")
        radius = max(samplers.distance_from_line(part.vertices, origin, axis) for part in target.moved.segments)
        most = np.rad2deg(samplers.FOLD_SHARE * length / radius)
        worst = max(abs(self.angle[0]), abs(self.angle[1]))
        if worst > most:
            raise Misfit(
                "angle",
                f"`angle` reaches {worst:g} degrees; an object that reaches {radius / target.unit:.4g} from "
                f"the axis folds over beyond {most:.3g} degrees on a length of {self.length:g}: bend less, or over a "
                "greater length",
            )
        return samplers.BendSampler(origin, axis, length, _radians(self.angle), toward)


class TwistBlock(DeformationBlock):
    """Twist about ``axis``, growing from nothing at ``origin`` to ``angle`` at ``length`` beyond it."""

    type: Literal["twist"]
    origin: Point
    axis: Direction
    length: Positive
    angle: Range

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of twists about the axis, in scene units and radians."""
        length = self.length * target.unit
        return samplers.TwistSampler(target.point(self.origin), np.array(self.axis), length, _radians(self.angle))


class TaperBlock(DeformationBlock):
    """Scaling of cross-sections by a factor from 1 at ``origin`` to ``factor`` at ``length`` beyond it."""

    type: Literal["taper"]
    origin: Point
    axis: Direction
    length: Positive
    factor: PositiveRange

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of tapers along the axis, in scene units."""
        length = self.length * target.unit
        return samplers.TaperSampler(target.point(self.origin), np.array(self.axis), length, self.factor)


class SquashBlock(DeformationBlock):
    """Scaling by ``factor`` along an axis, a random one where absent, with the volume kept."""

    type: Literal["squash"]
    factor: PositiveRange
    axis: Direction | None = None
    center: Point | None = None

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of squashes about ``center``, the middle of the whole object where absent."""
        center = target.whole.mean(axis=0) if self.center is None else target.point(self.center)
        return samplers.SquashSampler(center, None if self.axis is None else np.array(self.axis), self.factor)


class JointBlock(DeformationBlock):
    """Rigid motion: a turn by ``angle`` about ``axis`` through ``pivot``, a ``slide`` along it, a ``shift`` anywhere.

    Attributes:
        name: by which results have its value; then it has either an angle or a slide.
        follows: name of the joint that moves it: where that is at its least value, this one is at the first of its own,
            and at its second where that is at its greatest. They may come in either order.
        shift: largest displacement to either side along x, y and z.
    """

    type: Literal["joint"]
    name: Name | None = None
    follows: Name | None = None
    pivot: Point
    axis: Direction
    angle: tuple[Number, Number] = (0.0, 0.0)
    slide: tuple[Number, Number] = (0.0, 0.0)
    shift: tuple[Annotated[Number, Field(ge=0)], ...] = Field(default=(0.0, 0.0, 0.0), min_length=3, max_length=3)

    @field_validator("angle", "slide")
    @classmethod
    def _ascends(cls, value: Limits, info: Any) -> Limits:
        return value if info.data.get("follows") else _ascending(value)

    @model_validator(mode="after")
    def _has_single_value(self) -> "JointBlock":
        ranges = [each for each in (self.angle, self.slide) if each[0] != each[1]]
        if self.name is not None and (len(ranges) != 1 or any(self.shift)):
            raise ValueError("a joint with a name has one value, of its angle or of its slide: give one range alone")
        if self.follows is not None and self.name is None:
            raise ValueError("it follows a joint and has no name; results have its value by that: add one")
        return self

    @model_serializer(mode="wrap")
    def _written(self, write: Any) -> dict[str, object]:
        """Without the names that it lacks: an object's identity in datasets is made of it."""
        return {key: value for key, value in write(self).items() if value is not None or key not in ("name", "follows")}

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of rigid motions about the pivot, in scene units and radians."""
        slide = _lengths(self.slide, target)
        shift = np.array(self.shift) * target.unit
        axis = np.array(self.axis)
        names = self.name or "", self.follows or ""
        return samplers.JointSampler(target.point(self.pivot), axis, _radians(self.angle), slide, shift, *names)


def is_robot_joint(block: DeformationBlock) -> bool:
    """Whether a block is a joint with a name, as those of a robot's file are."""
    return isinstance(block, JointBlock) and block.name is not None


class PushBlock(DeformationBlock):
    """Push by an instrument at a random place of the surface.

    Attributes:
        distance: of its tip, outwards along the surface's normal or, where negative, inwards.
        tip: everything within this distance of the tip moves with it.
        reach: nothing moves beyond this one.
    """

    type: Literal["push"]
    distance: Range
    tip: Annotated[Number, Field(ge=0)]
    reach: Positive

    @model_validator(mode="after")
    def _is_invertible(self) -> "PushBlock":
        # the blend's slope is at most 15/8 over its width (``maps.smooth_step``)
        steepest = 15 / 8 * max(abs(self.distance[0]), abs(self.distance[1]))
        if not steepest < 0.95 * (self.reach - self.tip):
            raise ValueError(f"space would fold over; reach must be above {self.tip + steepest / 0.95:.4g}")
        return self

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of pushes of what is moved, in scene units."""
        unit = target.unit
        return samplers.PushSampler(_lengths(self.distance, target), self.tip * unit, self.reach * unit)


class HeldPlace(Block):
    """Part of an elastic solid that does not move: a ball, all on one side of a plane, or some of its nodes.

    Attributes:
        center: of the ball, or a point of the plane.
        radius: of the ball.
        direction: to the side of the plane that is held.
        points: file of points, in the unit and frame of the segments: the node nearest to each is held.
        nodes: numbers of nodes in the file of ``tetrahedra``, counted from 0.
    """

    center: Point | None = None
    radius: Positive | None = None
    direction: Direction | None = None
    points: FileName | None = None
    nodes: NonEmpty[NonNegativeInt] | None = None

    @model_validator(mode="after")
    def _has_single_kind(self) -> "HeldPlace":
        given = self.model_fields_set
        if given not in ({"center", "radius"}, {"center", "direction"}, {"points"}, {"nodes"}):
            raise ValueError(
                "a held place has either a radius (a ball) or a direction (a side of a plane), and a center, or else "
                "`points` or `nodes` alone: give one"
            )
        return self

    @property
    def name(self) -> str:
        """Phrase for people."""
        if self.center is None:
            return "the list of nodes" if self.points is None else f"the file {self.points}"
        return f"the place at {list(self.center)}"

    def depth(self, nodes: Points, numbers: Indices | None, target: Target) -> Values:
        """How far nodes of a solid, in the scene's frame, are inside, scene units; below 0 outside.

        ``numbers`` are those in their file. ``Misfit`` for points that cannot be read, and for numbers of no node.
        """
        if self.center is None:
            held = nodes[self._rows(nodes, numbers, target)]
            return -cKDTree(held).query(nodes)[0]
        offset = nodes - target.point(self.center)
        if self.direction is not None:
            return offset @ unit(np.array(self.direction))
        return (self.radius or 0.0) * target.unit - norm(offset, axis=1)

    def _rows(self, nodes: Points, numbers: Indices | None, target: Target) -> Int[np.ndarray, " r"]:
        """Rows of the nodes that are held one by one."""
        if self.nodes is None:
            try:
                points = model_points(read_points(target.folder / (self.points or ""))[:, :3])
            except (ValueError, OSError) as error:
                raise Misfit("held", str(error)) from error
            return cKDTree(nodes).query(target.placement.apply(points))[1]
        if numbers is None:
            raise Misfit("held", "a lattice has no nodes with numbers: name the file of `tetrahedra`, or give `points`")
        unknown = np.setdiff1d(self.nodes, numbers)
        if len(unknown):
            raise Misfit(
                "held",
                f"no tetrahedron has the node {unknown[0]}; they are {numbers.min()} to {numbers.max()}, counted from "
                "0 in the file's order: correct it",
            )
        return np.flatnonzero(np.isin(numbers, self.nodes))


SOFT, STIFF = 0.1, 0.025
"""``ElasticBlock.motion`` of what is soft, as organs are, and of what is stiff, as hard rubber is."""


MOST_LATTICE, MOST_TETRAHEDRA = 100_000, 200_000
"""Tetrahedra of a lattice, and of a volume mesh from a file: 160,000 of a liver take 146 s and 2.9 GB to find 100
modes, on two busy cores; 55,000 of a cube half as much, as more of them are neighbours."""

CELLS = (16, 24, 32, 48)
FULL = 0.6
"""Cells along the longest side of an elastic solid, and how full one is on average of those that hold material."""


class ElasticBlock(DeformationBlock):
    """States of an elastic solid under random loads.

    Attributes:
        motion: root mean square displacement, as a share of half the longest side.
        poisson: Poisson's ratio, the same for all segments.
        stiffness: Young's modulus of segments, in that of those which are not named.
        held: places that do not move against each other; nothing is held where absent.
        cells: of the lattice along its longest side; where absent, as few of ``CELLS`` as thin parts allow.
        tetrahedra: file of the object's own volume mesh, in the unit and frame of the segments, instead of a lattice.
        modes: how many ways to bend there are.
    """

    type: Literal["elastic"]
    motion: Annotated[FiniteFloat, Field(gt=0, le=0.5)] = SOFT
    poisson: Annotated[FiniteFloat, Field(gt=-1, lt=0.49)] = 0.4
    stiffness: dict[Name, Annotated[FiniteFloat, Field(ge=1e-3, le=1e3)]] = {}
    held: NonEmpty[HeldPlace] | None = None
    cells: Annotated[int, Field(ge=4, le=64)] | None = None
    tetrahedra: FileName | None = None
    modes: Annotated[int, Field(ge=1, le=150)] = 100

    @model_validator(mode="after")
    def _has_single_solid(self) -> "ElasticBlock":
        if self.cells is not None and self.tetrahedra is not None:
            raise ValueError("it has both cells and tetrahedra; one of them says what the solid is made of: drop one")
        return self

    def lattice(self, mesh: SegmentedMesh, stiffness: list[float] | None = None) -> ElasticSolid:
        """Lattice of ``cells``, or the coarsest of which a typical cell that holds material is half full."""
        for cells in CELLS if self.cells is None else (self.cells,):
            finer = build_lattice(mesh, cells, stiffness)
            if (count := len(finer.mesh.elements)) > MOST_LATTICE:
                if self.cells is None and cells > CELLS[0]:
                    break
                fitting = int(cells * (MOST_LATTICE / count) ** (1 / 3))
                raise Misfit(
                    "cells",
                    f"a lattice of {cells} cells has {count:,} tetrahedra here, and {MOST_LATTICE:,} is the most, for "
                    f"minutes: make it {fitting} or fewer, or leave it out",
                )
            solid = finer
            if np.average(solid.filled, weights=solid.volumes) >= FULL:
                break
        return solid

    def _volume(self, target: Target, stiffness: list[float] | None) -> tuple[ElasticSolid, Indices]:
        """Tetrahedra of the file, each as stiff as the segment around its middle, and their nodes' numbers in it."""
        path = target.folder / (self.tetrahedra or "")
        try:
            nodes, elements, numbers = read_tetrahedra(path)
            if len(elements) > MOST_TETRAHEDRA:
                raise ValueError(
                    f"{path} has {len(elements)} tetrahedra, and {MOST_TETRAHEDRA} is the most: mesh it coarser, or "
                    "leave `tetrahedra` out for a lattice"
                )
            mesh = tetrahedra_around(path, target.placement.apply(nodes), elements, target.moved)
        except (ValueError, FileNotFoundError) as error:
            raise Misfit("tetrahedra", str(error)) from error
        factor = None
        if stiffness is not None:
            labels = Solids(target.moved).label(mesh.nodes[mesh.elements].mean(axis=1))
            factor = np.concatenate([[1.0], stiffness])[labels]
        return ElasticSolid(mesh, np.ones(len(elements)), factor), numbers

    def sampler(self, target: Target) -> DeformationSampler:
        """Sampler of states of all segments as one solid, in scene units.

        ``Misfit`` for unknown segments, for places that hold nothing, and for segments that are not in one piece.
        """
        names = list(target.moved.names)
        bounds = target.moved.bounds
        for name in self.stiffness:
            if name not in names:
                raise Misfit("stiffness", f"no segment is called {name!r}: {similar(name, names)}")
        stiffness = [self.stiffness.get(name, 1.0) for name in names] if self.stiffness else None
        if self.tetrahedra is None:
            solid = self.lattice(target.moved, stiffness)
            numbers = None
        else:
            solid, numbers = self._volume(target, stiffness)
        if (pieces := solid.pieces) > 1:
            if self.tetrahedra is not None:
                raise Misfit(
                    "tetrahedra",
                    f"the tetrahedra are {pieces} pieces that share no faces; a solid is one piece: merge nodes that "
                    "lie in one place, or leave out the smaller pieces",
                )
            raise Misfit(
                "type",
                f"the segments are {pieces} pieces that do not touch; an elastic solid is one: give each piece a block "
                "of its own with `segments`",
            )
        held = None
        for place in self.held or ():
            depth = place.depth(solid.mesh.nodes, numbers, target)
            inside = depth >= 0
            if not 3 <= inside.sum() < len(inside) - 3:
                least = float(np.sort(-depth)[2]) / target.unit
                raise Misfit(
                    "held",
                    f"{place.name} holds {inside.sum()} of {len(inside)} nodes of the solid; it "
                    f"must hold 3 or more, and not all: it gets 3 where it reaches {least:.3g} farther",
                )
            held = inside if held is None else held | inside
        count = min(self.modes, solid.most_modes(held))
        motion = self.motion * longest_side(bounds) / 2
        return ElasticSampler(solid, Material(self.poisson), count, motion, held)


AnyDeformation = (
    LatticeBlock
    | WavesBlock
    | BendBlock
    | TwistBlock
    | TaperBlock
    | SquashBlock
    | JointBlock
    | PushBlock
    | ElasticBlock
)

WORDS: dict[str, list[dict[str, object]]] = {
    "rigid": [],
    "soft": [{"type": "elastic", "motion": SOFT}],
    "stiff": [{"type": "elastic", "motion": STIFF}],
}
"""Deformations that one word says."""


def _spelled_out(value: object) -> object:
    """Blocks of a word."""
    if isinstance(value, str) and value not in WORDS:
        raise ValueError(f"{value!r} is no way to deform; it must be {', '.join(WORDS)}, or a list of deformations")
    return WORDS[value] if isinstance(value, str) else value


Deformations = Annotated[list[Annotated[AnyDeformation, Field(discriminator="type")]], BeforeValidator(_spelled_out)]
"""A list of deformations, told apart by their ``type``, or a word of ``WORDS``."""


def _lengths(values: Limits, target: Target) -> Limits:
    """A range of lengths in scene units."""
    return values[0] * target.unit, values[1] * target.unit


def _radians(degrees: Limits) -> Limits:
    return radians(degrees[0]), radians(degrees[1])


# --- scene files ------------------------------------------------------------------------------------------------------

# What a scene file may say: one class per block, its fields the keys, their types the rules.
#
# Lengths and places are in the file's own unit and frame, those of its meshes; the camera's distances and ``size`` are
# in scene units, the unit of datasets and weights. Angles are in degrees. ``docs/scene-file.md`` explains every key.

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
    """Segment from a mesh file of its own.

    Attributes:
        file: of the mesh.
        frame: pose at rest of the frame that results have the pose of, as a robot's link has one; that of the files
            where absent.
    """

    file: FileName
    frame: Annotated[list[list[Number]], AfterValidator(_placing)] | None = None


class ModelPart(PartLook):
    """Segment from one or more named parts of ``model``; by default the part that is called as it is."""

    parts: NonEmpty[str] | None = None


def _any_roll(value: object) -> object:
    """A truth value; an angle, which it is easily taken for, is refused."""
    if not isinstance(value, bool):
        raise ValueError("it must be true, where the camera may be rolled by any angle, or false, where by none")
    return value


class CameraBlock(Block):
    """Workspace of the camera, ``scenes.scene.Workspace`` in degrees.

    The defaults stay those of the paper, although new files state 360: datasets and weights record them in the
    definition of a file that states no camera.
    """

    aperture: Annotated[FiniteFloat, Field(gt=0, le=360)] = 140.0
    distance: PositiveRange = (100.0, 200.0)
    axis: Direction = (0.0, 0.0, 1.0)
    roll: Annotated[bool, BeforeValidator(_any_roll)] = False
    field_of_view: Annotated[FiniteFloat, Field(gt=0, lt=170)] = 35.0

    def workspace(self) -> Workspace:
        """Workspace that this block describes, angles in radians."""
        return Workspace(
            aperture_rad=radians(self.aperture),
            distance=self.distance,
            axis=self.axis,
            any_roll=self.roll,
            fov_rad=radians(self.field_of_view),
        )


class StatesBlock(Block):
    """Recorded states: file, directory or pattern of positions, and the file of their mesh at rest."""

    positions: FileName
    mesh: FileName | None = None

    @model_serializer
    def _written(self) -> str | Texts:
        """The path alone where there is no mesh: an object's identity in datasets is made of it."""
        return self.positions if self.mesh is None else {"positions": self.positions, "mesh": self.mesh}


def _states(value: object) -> object:
    """A path alone is that of the positions."""
    if isinstance(value, str):
        return {"positions": value}
    if not isinstance(value, dict):
        raise ValueError("it must be a path, or a block of the keys positions and mesh")
    return value


class SceneFile(Block):
    """Content of a scene file. Exactly one of ``segments``, ``model``, ``labels`` says where the segments come from.

    Attributes:
        name: identifies the scene in datasets and weights.
        units: metres per unit of the meshes.
        source: where they come from, and their licence.
        segments: a mesh file for each.
        model, parts: one file of named parts, and which of them to take; all where ``parts`` is absent.
        robot_meshes: of a ``model`` that is a robot's file, as of ``MeshesConfig``.
        labels, names, cells: a label volume, or a list of them with a segment each, whose values count from 1; which
            values are which segments, and the number of cells along the longest side of the grid on which their
            surfaces are found.
        size: length of the object's shortest side, in scene units.
        camera: its workspace.
        deformations: applied in this order; ``template.default_deformations`` where absent.
        states, held_out: recorded states instead of deformations, and the share of frames kept for testing.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    units: Annotated[Positive, BeforeValidator(_unit_m)]
    source: str = "the user's own"
    segments: NonEmpty[FilePart] | None = None
    model: FileName | None = None
    parts: NonEmpty[ModelPart] | None = None
    robot_meshes: RobotMeshes = "visual"
    labels: FileName | Annotated[list[FileName], Field(min_length=2)] | None = None
    names: Annotated[dict[Annotated[int, Field(ge=1)], Name], Field(min_length=1)] | None = None
    cells: Annotated[int, Field(ge=16, le=400)] = 64
    size: Positive = 20.0
    camera: CameraBlock = CameraBlock()
    deformations: Deformations | None = None
    states: Annotated[StatesBlock, BeforeValidator(_states)] | None = None
    held_out: ProperShare = 0.1

    @model_validator(mode="after")
    def _moves_in_single_way(self) -> "SceneFile":
        if self.states is not None and self.deformations is not None:
            raise ValueError("it has both states and deformations; recorded states say how the object moves: drop one")
        return self

    @model_validator(mode="after")
    def _has_single_source(self) -> "SceneFile":
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
