"""Scenes: a segmented model at rest, its random deformations, and where a camera may stand (paper, appendix B)."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import pi, radians
from pathlib import Path

import numpy as np
from numpy.linalg import det
from numpy.random import Generator

from mereo.deformation.maps import Deformations
from mereo.geometry.brief import counted, listed
from mereo.geometry.conventions import Facts, Range, Triple, WorkspaceName
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import NamedPoses, Transform, Vector, look_at, rotation_along
from mereo.io.atomic_files import JsonObject
from mereo.io.config import Space
from mereo.scenes.seeds import TEST_SEED_START


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """Similarity from the frame of an object's own files, and metres per scene unit, None where they are not known.

    ``space`` is the anatomical frame that the files name, if any; ``link_frames`` are the poses at rest of the frames
    that a robot's file gives its links, in the files' frame and unit, by the names of the segments.
    """

    T_scene_source: Transform
    unit_m: float | None
    space: Space | None = None
    link_frames: NamedPoses = field(default_factory=NamedPoses)

    @property
    def scale(self) -> float:
        """Scene units per unit of the files."""
        return float(np.cbrt(det(self.T_scene_source[:3, :3])))

    def facts(self) -> JsonObject:
        """Plain values for a file's header."""
        links = {name: frame.tolist() for name, frame in self.link_frames.items()}
        known = {"T_scene_source": self.T_scene_source.tolist(), "unit_m": self.unit_m, "space": self.space}
        return {**known, **({"link_frames": links} if links else {})}

    @classmethod
    def of_facts(cls, facts: Facts | None) -> "SourceFrame | None":
        """Inverse of ``facts``; None for files from before it was known."""
        if facts is None:
            return None
        links = {name: np.asarray(frame, float) for name, frame in facts.get("link_frames", {}).items()}
        return cls(np.asarray(facts["T_scene_source"], float), facts["unit_m"], facts.get("space"), links)


GUESSED_UNIT_M = 0.01
"""Metres per scene unit of built-in objects that are no real ones, and of objects of unknown size in sample views."""

SCENES = (
    *("human", "robot", "bunny", "lizard", "rope", "skull", "engine", "liver", "shapes", "sheet"),
    *("tumor", "liver-simulated"),
)
"""Built-in scenes, one module each in ``mereo_objects``: the paper's ten, then ours."""

PAPER_APERTURE_RAD, WHOLE_SPHERE_RAD = radians(140.0), radians(360.0)


class AssetUnavailable(OSError):
    """Error of a file that no mirror, cache or download gives; the text says how to get it."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """Places where the camera may be: a cone around ``axis`` with its tip at the object (paper, appendix B).

    Attributes:
        aperture_rad: full opening angle of the cone; 2 pi is the whole sphere.
        distance: nearest and farthest distance from the object's centre, in scene units.
        axis: direction from the object to the middle of the workspace, in the scene's frame.
        any_roll: whether the camera may be rolled about its viewing axis; otherwise its x axis stays perpendicular
            to ``axis`` (the horizon is level).
        fov_rad: full angle of view of the square image.
    """

    aperture_rad: float = PAPER_APERTURE_RAD
    distance: Range = (100.0, 200.0)
    axis: Triple = (0.0, 0.0, 1.0)
    any_roll: bool = False
    fov_rad: float = radians(35.0)

    @property
    def all_around(self) -> bool:
        """Whether it is the whole sphere, which has no middle."""
        return self.aperture_rad >= WHOLE_SPHERE_RAD

    def sample(self, rng: Generator, target: Vector) -> Transform:
        """Pose ``T_world_camera`` of a camera aimed at ``target``, uniform in direction and in distance."""
        cosine = rng.uniform(np.cos(min(self.aperture_rad / 2, pi)), 1.0)
        azimuth = rng.uniform(0.0, 2 * pi)
        distance = rng.uniform(*self.distance)
        roll = rng.uniform(0.0, 2 * pi) if self.any_roll else 0.0
        return self.pose(target, cosine, azimuth, distance, roll)

    def pose(
        self, target: Vector, cosine: float, azimuth_rad: float, distance: float, roll_rad: float = 0.0
    ) -> Transform:
        """Pose ``T_world_camera`` of a camera aimed at ``target``, by its azimuth and the cosine of its tilt."""
        sine = np.sqrt(1.0 - cosine**2)
        local = np.array([sine * np.cos(azimuth_rad), sine * np.sin(azimuth_rad), cosine])
        to_camera = rotation_along(np.asarray(self.axis, float)) @ local
        return look_at(target + distance * to_camera, target, np.asarray(self.axis, float), roll_rad)


@dataclass(frozen=True, eq=False)
class State:
    """Random state of a scene in its own (world) frame, and for each segment the map of space from its rest pose."""

    mesh: SegmentedMesh
    deformations: Deformations


Draw = Callable[[Generator], Deformations]
"""How one deformation is drawn for each segment."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Deformable object to learn.

    Attributes:
        name: stable identifier.
        rest: the segments at rest, in scene units (shortest dimension about 20, less for what is long and thin).
        sample_deformations: draws one deformation per segment; segments that move together share one object.
        workspace: where the camera may be.
        cone: where else it may be, of a scene whose ``workspace`` is the whole sphere; by default the paper's cone
            about the workspace's axis.
        source: where the mesh comes from, and its licence.
        held_out: the same object in states that are kept for testing; None where states are drawn without end.
        unit_m: metres per scene unit; None where the object's true size is not known.
        T_scene_source: similarity from the frame and unit of the files that the object was read from to the scene's;
            the identity where it is defined in scene units.
        space: anatomical frame of those files, where they name one.
        link_frames: as of ``SourceFrame``; empty where those are no robot's.
        definition: what a scene from a file states, in a text that changes exactly when its meaning does. Empty for
            built-in scenes: the version of mereo stands for it.
        file: scene file that it was read from, as it was named; None for others.
    """

    name: str
    rest: SegmentedMesh
    sample_deformations: Draw
    workspace: Workspace = Workspace()
    source: str = "modelled in mereo's own code, MIT licence"
    held_out: "Scene | None" = None
    unit_m: float | None = None
    T_scene_source: Transform = field(default_factory=lambda: np.eye(4))
    definition: str = ""
    cone: Workspace | None = None
    file: Path | None = None
    space: Space | None = None
    link_frames: NamedPoses = field(default_factory=NamedPoses)

    def __post_init__(self) -> None:
        if self.held_out is not None and self.held_out.rest.names != self.rest.names:
            raise ValueError(
                f"scene {self.name!r} has the segments {', '.join(self.rest.names)} but its held-out states "
                f"{', '.join(self.held_out.rest.names)}; they must be one object: give both the same rest mesh"
            )

    def __repr__(self) -> str:
        unit = "of unknown size" if self.unit_m is None else f"a unit is {1000 * self.unit_m:.3g} mm"
        segments = f"{counted(len(self.rest.segments), 'segment')}: {listed(self.rest.names)}"
        return f"Scene({self.name!r}, {segments}; {unit})"

    @property
    def source_frame(self) -> SourceFrame:
        """Frame of the object's own files."""
        return SourceFrame(self.T_scene_source, self.unit_m, self.space, self.link_frames)

    def workspace_named(self, name: WorkspaceName) -> Workspace:
        """Workspace of the scene by name, at its own distances and with its own angle of view.

        "own" is ``workspace``. "cone" and "sphere" are that too where it is one, so that scenes can be compared; else
        the cone of the scene, with a level horizon, and the whole sphere at any roll.
        """
        workspace = self.workspace
        if name == "cone" and workspace.all_around:
            return self.cone or replace(workspace, aperture_rad=PAPER_APERTURE_RAD, any_roll=False)
        if name == "sphere" and not workspace.all_around:
            return replace(workspace, aperture_rad=WHOLE_SPHERE_RAD, any_roll=True)
        return workspace

    def for_seed(self, seed: int) -> "Scene":
        """Scene that a seed draws from: its held-out states for testing (``TEST_SEED_START`` up), or itself."""
        return self.held_out if self.held_out is not None and seed >= TEST_SEED_START else self

    def sample_state(self, rng: Generator) -> State:
        """Random deformed state within the scene's hand-made bounds."""
        return self.deform(self.sample_deformations(rng))

    def deform(self, deformations: Deformations) -> State:
        """State made by one deformation per segment; vertices shared by a common map are moved in one call."""
        moved = [np.empty((0, 3))] * len(deformations)
        for shared in {id(each): each for each in deformations}.values():
            members = [index for index, each in enumerate(deformations) if each is shared]
            parts = [self.rest.segments[index].vertices for index in members]
            pieces = np.split(shared(np.concatenate(parts)), np.cumsum([len(part) for part in parts])[:-1])
            for index, piece in zip(members, pieces, strict=True):
                moved[index] = piece
        return State(self.rest.with_vertices(moved), deformations)
