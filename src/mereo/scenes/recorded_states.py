"""Simulated states: an object's deformations taken from a simulator's recorded frames instead of drawn by formula.

A random state is one recorded frame, drawn at random. Frames are finitely many, so some are kept for testing: training
and test seeds never share one. See docs/design/0008-simulated-states.md for formats and accuracy.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.simulation_states import TetrahedralRecord, read_states
from mereo.scenes.recorded_frames import surface_frames, tetrahedral_frames
from mereo.scenes.scene import Scene, Workspace

HELD_OUT = 0.1
"""The share of frames, the last ones, that is kept for testing."""


@runtime_checkable
class Frames(Protocol):
    """Recorded states as deformations of an object at rest."""

    @property
    def count(self) -> int:
        """Number of recorded states."""
        ...

    def deformations(self, frame: int) -> tuple[Deformation, ...]:
        """Deformations of the segments in one recorded state."""
        ...


@dataclass(frozen=True, eq=False)
class States:
    """Some of the recorded frames, to draw from.

    Attributes:
        frames: all of them.
        first, end: those drawn from, without the end.
    """

    frames: Frames
    first: int
    end: int

    def sample(self, rng: np.random.Generator) -> tuple[Deformation, ...]:
        """Deformations of one random frame, each as likely as the other."""
        return self.frames.deformations(int(named(rng, "frame").integers(self.first, self.end)))


@dataclass(frozen=True, eq=False)
class SplitStates:
    """Recorded states in two parts that share no frame.

    Attributes:
        training: all but the last frames.
        testing: the last ones; None where none are held out.
    """

    training: States
    testing: States | None

    def sample(self, rng: np.random.Generator) -> tuple[Deformation, ...]:
        """Deformations of one random frame for training."""
        return self.training.sample(rng)

    def scene(self, name: str, rest: SegmentedMesh, workspace: Workspace, source: str) -> Scene:
        """Scene in these states; its ``held_out`` draws from ``testing``."""
        held_out = None if self.testing is None else Scene(name, rest, self.testing.sample, workspace, source)
        return Scene(name, rest, self.training.sample, workspace, source, held_out)


def load_states(
    path: Path,
    rest: SegmentedMesh,
    *,
    scale: float = 1.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    held_out: float = HELD_OUT,
) -> SplitStates:
    """Recorded states of an object.

    Args:
        path: an NPZ file or a directory, see docs/design/0008-simulated-states.md.
        rest: the object at rest, in scene units.
        scale: ``scene = file * scale + shift`` takes the file's coordinates to those of ``rest``.
        shift: see ``scale``.
        held_out: the share of frames, the last ones, kept for testing: from 0 to less than 1.

    Raises:
        FileNotFoundError: nothing at ``path``.
        ValueError: damaged files, frames that do not fit ``rest``, or frames that turn something inside out, which are
            named.
    """
    offset = np.asarray(shift, dtype=np.float64)
    if not (np.isfinite(scale) and scale > 0 and offset.shape == (3,) and np.isfinite(offset).all()):
        raise ValueError(f"scale is {scale} and shift {shift}; they must be finite, scale above 0, shift of 3 numbers")
    record = read_states(Path(path), rest.names)
    frames: Frames
    if isinstance(record, TetrahedralRecord):
        frames = tetrahedral_frames(path, record, rest, scale, offset)
    else:
        frames = surface_frames(path, record, rest, scale, offset)
    return _split(path, frames, held_out)


def _split(path: Path, frames: Frames, held_out: float) -> SplitStates:
    if not 0 <= held_out < 1:
        raise ValueError(f"held_out is {held_out}; the share of frames for testing is from 0 to less than 1: take 0.1")
    count = frames.count
    kept = max(1, round(count * held_out)) if held_out else 0
    if kept >= count:
        raise ValueError(
            f"{path} has {count} frames, of which {kept} would be held out for testing; at least one must be left for "
            "training: record more, or set held_out to 0"
        )
    testing = States(frames, count - kept, count) if kept else None
    return SplitStates(States(frames, 0, count - kept), testing)
