"""Stage of the laboratory: what is found and what is true, the points seen, and the camera at its place."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.synthesis.examples import View
from mereo.visualization.vertex_colors import (
    CONFIDENCE,
    ColorScale,
    confidence,
    distance_scale,
    error_scale,
    observed_distance,
    surface_error,
)
from mereo.visualization.viewer.display import Display, SegmentLayer, Shown
from mereo.visualization.viewer.laboratory import Laboratory, Trial, depth_picture
from mereo.visualization.viewer.sight import Sight

SHOWN = ("reconstruction", "truth", "side by side")
COLORINGS = ("segment", "error", "confidence", "distance")
ASIDE = 1.2
"""Shift of each of two objects side by side, in stage units, along the camera's horizon."""

UNDER = 0.12
"""Distance of a name below what it names, in stage units."""


@dataclass(frozen=True, eq=False)
class Moment:
    """Moment that the page shows: a state as it is seen, and what has been made of that so far."""

    view: Sight
    trial: Trial | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """What of a moment a mode shows, and where.

    Attributes:
        found, true: reconstruction and truth in the camera frame; None where it is not shown.
        aside: shift of the truth on the stage; the reconstruction and the points are as far the other way.
    """

    found: SegmentedMesh | None
    true: SegmentedMesh | None
    aside: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, moment: Moment, mode: str) -> "Placed":
        """What one of ``SHOWN`` shows."""
        found = None if moment.trial is None or mode == "truth" else moment.trial.reconstruction.surfaces
        aside = (ASIDE if mode == "side by side" else 0.0) * moment.view.T_world_camera[:3, 0]
        return cls(found, None if mode == "reconstruction" else moment.view.mesh, aside)

    @property
    def meshes(self) -> tuple[tuple[SegmentedMesh | None, Float[np.ndarray, "3"]], ...]:
        """Both, each with its shift."""
        return (self.found, -self.aside), (self.true, self.aside)


class LabStage:
    """Stage that shows a ``Moment`` in the scene's frame."""

    def __init__(self, server: Any, laboratory: Laboratory) -> None:
        self.server, self.laboratory = server, laboratory
        rest = laboratory.scene.rest
        self.stage = Display(server, rest.bounds, np.asarray(laboratory.scene.workspace.axis, dtype=float))
        self.found, self.true = SegmentLayer(self.stage, "/found"), SegmentLayer(self.stage, "/true")
        self._names: list[Any] = []

    def draw(self, moment: Moment, mode: str, coloring: str, shown: Shown, points: bool) -> ColorScale | None:
        """Show a moment; returns the scale that the surfaces are coloured by, None for the segments' own colours.

        Args:
            moment: what is shown.
            mode: one of ``SHOWN``.
            coloring: one of ``COLORINGS``, of what is found.
            shown: choice of the segments.
            points: whether those that the camera sees are shown.
        """
        T_world_camera, placed = moment.view.T_world_camera, Placed.of(moment, mode)
        self._draw_camera(moment.view, -placed.aside, points)
        self._clear_names()
        if placed.true is None:
            self.true.clear_from()
        else:
            self.true.show(placed.true.transformed(T_world_camera), shown, shift=placed.aside)
        if placed.found is None or moment.trial is None:
            self.found.clear_from()
            return None
        if placed.true is not None:
            self._name("reconstruction", placed.found, moment.view, -placed.aside)
            self._name("truth", placed.true, moment.view, placed.aside)
        painted = self._colors(coloring, moment.view, moment.trial)
        colors, scale = (None, None) if painted is None else painted
        self.found.show(placed.found.transformed(T_world_camera), shown, colors, -placed.aside)
        return scale

    def shown(self, moment: Moment, mode: str, shown: Shown) -> tuple[list[SegmentedMesh], Float[np.ndarray, "n 3"]]:
        """Meshes and observed points as ``draw`` puts them on the stage, in the segments' own colours."""
        placed = Placed.of(moment, mode)
        meshes = [(mesh, shift) for mesh, shift in placed.meshes if mesh is not None]
        staged = [self._staged(mesh, moment.view.T_world_camera, shift, shown) for mesh, shift in meshes]
        return staged, self._seen(moment.view) - placed.aside

    def _seen(self, view: View) -> Float[np.ndarray, "n 3"]:
        """The observed points, on the stage."""
        return self.stage.place(transform_points(view.T_world_camera, view.depth.to_points().points))

    def _staged(
        self, mesh: SegmentedMesh, T: Float[np.ndarray, "4 4"], shift: Float[np.ndarray, "3"], shown: Shown
    ) -> SegmentedMesh:
        """Visible segments of a mesh of the camera's frame, on the stage."""
        chosen = [s for s, visible in zip(mesh.segments, shown.visible(), strict=True) if visible and len(s.faces)]
        names = {segment.name for segment in chosen}
        nested = tuple(pair for pair in mesh.nested if names.issuperset(pair))
        moved = SegmentedMesh(tuple(chosen), nested).transformed(T) if chosen else SegmentedMesh(())
        return moved.with_vertices([self.stage.place(segment.vertices) + shift for segment in moved.segments])

    def _clear_names(self) -> None:
        for name in self._names:
            name.remove()
        self._names = []

    def _name(self, text: str, mesh: SegmentedMesh, view: View, shift: Float[np.ndarray, "3"]) -> None:
        """A word under a mesh of the camera's frame, as the camera has it: y is down."""
        low, high = mesh.bounds
        foot = np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
        place = self.stage.place(transform_points(view.T_world_camera, foot[None]))[0] + shift
        place += UNDER * view.T_world_camera[:3, 1]
        self._names.append(
            self.server.scene.add_label(f"/names/{text}", text, position=tuple(place), anchor="top-center")
        )

    def _draw_camera(self, view: View, shift: Float[np.ndarray, "3"], points_on: bool) -> None:
        """The observed points, and the camera with its image at its place."""
        scene, T_world_camera = self.server.scene, view.T_world_camera
        self.stage.show_points("/points", self._seen(view) + shift, points_on)
        x, y, z, w = Rotation.from_matrix(T_world_camera[:3, :3]).as_quat()
        scene.add_camera_frustum(
            "/camera",
            self.laboratory.scene.workspace.fov_rad,
            1.0,
            scale=0.35,
            color=(150, 160, 176),
            image=depth_picture(view.depth),
            format="png",
            wxyz=(w, x, y, z),
            position=tuple(self.stage.place(T_world_camera[:3, 3])),
        )

    def _colors(self, mode: str, view: View, trial: Trial) -> tuple[list[UInt8[np.ndarray, "_ 3"]], ColorScale] | None:
        """Colours of the reconstruction's vertices, and their scale; None for the segments' own."""
        surfaces = trial.reconstruction.surfaces
        if mode == "segment":
            return None
        scale: ColorScale
        if mode == "error":
            values, scale = surface_error(surfaces, Solids(view.mesh)), error_scale(view.mesh, "")
        elif mode == "confidence":
            assert self.laboratory.model is not None and trial.reconstruction.code is not None
            values, scale = (
                confidence(surfaces, partial(self.laboratory.model.query, trial.reconstruction.code)),
                CONFIDENCE,
            )
        else:
            values = observed_distance(surfaces, view.depth.to_points().points)
            scale = distance_scale(values, "")
        return [scale.colors(value) for value in values], scale
