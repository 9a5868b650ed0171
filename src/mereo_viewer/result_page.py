"""Page of a result: surfaces and what was observed, their colours, and a probe.

Answer -content_of_answer-> Content -ResultPage-> page
folder of results, or any GLB file -content_of_files-> Content
"""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.registration import nearest_labels
from mereo.geometry.brief import as_exact_as, counted, rounded
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.solids import Solids, signed_distance_and_direction
from mereo.geometry.transforms import box_of, inverse_rigid, rigid, rotation_along, transform_points
from mereo.io.errors import words_of
from mereo.io.mesh_formats import GlbScene, is_glb, read_glb
from mereo.io.writers.formats import WRITERS
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.models.trained import Answer as NetworkAnswer
from mereo.results.joints import measure_joints
from mereo.results.state import STATE
from mereo.visualization.color_scales import (
    CONFIDENCE,
    ColorScale,
    confidence,
    distance_scale,
    observed_distance,
    radius_scale,
)
from mereo.visualization.contact_sheets import Picture, depth_ends, depth_picture
from mereo.visualization.reconstruction_report import REPORT, joint_table, read_report
from mereo.visualization.result_files import radii_of, to_viewer_of
from mereo.visualization.units import UNKNOWN, Unit
from mereo_viewer.display import (
    BOX,
    SOFT,
    Display,
    PointLayer,
    SegmentControls,
    SegmentLayer,
    bars,
    color_bar,
    enlarged,
    heading,
    hint,
    message,
)
from mereo_viewer.server import OpenPage, import_viser, start_server

EMPTY_COLOR = (150, 156, 168)

# --- probe ------------------------------------------------------------------------------------------------------------

# Probe of an answer or of surfaces, in the input's frame: what is known of a point, and which point a look meets.

ON_SURFACE = 1e-6
"""Distance, as a share of a place's coordinates, that is none: a click meets the surface up to rounding."""


@dataclass(frozen=True, eq=False)
class Probed:
    """Facts about points of the input's frame, in its unit.

    Attributes:
        label: 0 for empty space, i + 1 for segment i.
        distance: to the nearest segment surface, negative inside; NaN where that is not known.
        direction: unit vector towards it; NaN where that is not known.
        probability: of empty space and each segment, by the network; None where there is none.
        rest: where the point was at rest, scene units; None where no model is registered.
        radius95: radius around the point that holds the true place of what is registered there with probability 0.95;
            None where that is not known.
    """

    label: UInt8[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    direction: Float[np.ndarray, "n 3"]
    probability: Float[np.ndarray, "n c"] | None = None
    rest: Float[np.ndarray, "n 3"] | None = None
    radius95: Float[np.ndarray, " n"] | None = None


def source_of(answer: Answer) -> str:
    """Where an answer comes from, and whether its frame shows the object, in a phrase for people."""
    if answer.registrar is None:
        return "network alone: the weights carry no statistical model"
    doubt = None if answer.registration is None else answer.recognition.description
    return answer.source if doubt is None else f"{answer.source}; {doubt}"


def ask_network(answer: Answer, points: Float[np.ndarray, "n 3"]) -> NetworkAnswer:
    """Answers of the network at points of the input's frame, in that frame; it must have been given the frame."""
    result = answer.reconstruction
    assert answer.model is not None and result.code is not None
    network = answer.model.query(result.code, transform_points(result.T_camera_input, points))
    direction = network.direction @ result.T_camera_input[:3, :3]
    return NetworkAnswer(network.label, network.probability, network.distance, direction)


def probe_answer(answer: Answer, points: Float[np.ndarray, "n 3"]) -> Probed:
    """Facts about points of the input's frame: those of the registered model where it is the answer."""
    network = None if answer.reconstruction.code is None else ask_network(answer, points)
    if answer.registered is None:
        assert network is not None
        return Probed(network.label, network.distance, network.direction, network.probability)
    model = answer.registered.query(points)
    return Probed(
        _with_surface(answer.registered.solids, model.label, model.distance, points),
        model.distance,
        model.direction,
        None if network is None else network.probability,
        model.rest,
        answer.registered.radius95(points, at="camera"),
    )


def probe_surfaces(solids: Solids, radii: Radii | None, points: Float[np.ndarray, "n 3"]) -> Probed:
    """Facts about points that closed surfaces alone say."""
    inside = solids.label(points)
    distance, direction = signed_distance_and_direction(solids, points, inside)
    label = _with_surface(solids, inside, distance, points)
    radius = None
    if radii is not None and label.all():
        radius = np.concatenate([radii.at(point[None], int(row)) for point, row in zip(points, label, strict=True)])
    return Probed(label, distance, direction, radius95=radius)


def _with_surface(
    solids: Solids, label: UInt8[np.ndarray, " n"], distance: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 3"]
) -> UInt8[np.ndarray, " n"]:
    """Labels, where a place on a surface is its segment's, whichever side rounding has put it on."""
    on_surface = (label == 0) & (np.abs(distance) <= ON_SURFACE * np.abs(points).max(axis=1))
    return np.where(on_surface, nearest_labels(solids, points), label).astype(np.uint8)


def nearest_to_ray(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The point that is nearest to a ray by the angle at its origin."""
    away = points - origin
    return points[(away @ direction / np.linalg.norm(away, axis=1)).argmax()]


def first_point(
    mesh: SegmentedMesh, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], shown: list[bool]
) -> Float[np.ndarray, "3"] | None:
    """Place where a ray first meets the surface of a segment that is shown; None where it meets none."""
    segments = tuple(s for s, visible in zip(mesh.segments, shown, strict=True) if visible and len(s.faces))
    if not segments:
        return None
    T_mesh_ray = rigid(rotation_along(direction), origin)  # the ray is the z axis
    seen = Solids(SegmentedMesh(segments).transformed(inverse_rigid(T_mesh_ray)))
    distance = seen.first_hit(np.array([[0.0, 0.0, 1.0]])).distance[0]
    return transform_points(T_mesh_ray, np.array([0.0, 0.0, distance])) if np.isfinite(distance) else None


def probe_html(
    probed: Probed, names: Sequence[str], colors: Sequence[Color], point: Float[np.ndarray, "3"], unit: Unit
) -> str:
    """Facts about one point: its segment, the network's likeliest classes, distance, direction, and where it rests."""
    label = int(probed.label[0])
    distance = float(probed.distance[0])
    direction = probed.direction[0]
    radius = None if probed.radius95 is None else float(probed.radius95[0])
    where = f"at {unit.place(point, radius)} {unit.length_name}"
    where += "" if radius is None else " (95\N{NO-BREAK SPACE}%)"
    if abs(distance) <= ON_SURFACE * float(np.abs(point).max()):
        text = "on the surface"
    elif np.isnan(distance):
        text = "distance not trained"
    else:
        off = abs(distance) * unit.length_factor
        (length,) = as_exact_as(unit.length_factor * (radius or 0.0), off)
        text = f"{length} {unit.length_name} {'inside' if distance < 0 else 'outside'} the nearest surface"
    toward = "" if np.isnan(direction).any() else f"towards {_vector(direction)}"
    rest = "" if probed.rest is None else f"<br>at rest at {_vector(probed.rest[0])} scene units"
    likeliest = ""
    if probed.probability is not None:
        order = np.argsort(-probed.probability[0], kind="stable")[:4]
        likeliest = bars([(names[k], colors[k], float(probed.probability[0, k])) for k in order])
        if probed.rest is not None:
            likeliest = f'<div style="{BOX};{SOFT}">the network says</div>{likeliest}'
    return (
        f'<div style="{BOX}"><b>{escape(names[label])}</b> <span style="{SOFT}">{where}</span></div>'
        f'{likeliest}<div style="{BOX}">{escape(text)}<br><span style="{SOFT}">{toward}{rest}</span></div>'
    )


def _vector(values: Float[np.ndarray, "3"]) -> str:
    return ", ".join(f"{float(value):.3g}" for value in values)


# --- contents ---------------------------------------------------------------------------------------------------------

SEGMENT, VERTEX, SURE = "segment", "own", "how sure"
"""Colourings: by segment; by the colours of a file's vertices; by the radius that holds each vertex's true place."""

Colors = list[UInt8[np.ndarray, "_ 3"]]
"""Colours of the vertices of each segment."""

Picks = tuple[PointCloud, Callable[[Float[np.ndarray, "3"]], Answer]]
"""All that a camera saw, and what answers the frame at a point of it."""

Coloring = Callable[[], tuple[Colors, ColorScale | None]]
"""Function that colours the vertices, and says by which scale."""


@dataclass(frozen=True, eq=False)
class Content:
    """What a page of a result shows.

    Attributes:
        title, facts: heading.
        verdict: where the surfaces come from, and whether to trust them.
        mesh: surfaces, in the input's frame.
        unit: of that frame.
        rotation: from it to x right, y up, z toward the eye.
        cloud: observed points, in that frame.
        depth: picture of the depth image, and the nearest and farthest depth in words.
        colorings: other colours than those of the segments, by name; the first shown first where it is ``VERTEX``.
        ask: what is known of places; None where there is nothing to probe.
        is_doubtful: whether the verdict is that the surfaces are not to be trusted.
        picks: what a click can say where the object is in; None where nothing is looked for.
        joints: HTML of their table; empty without any.
    """

    title: str
    facts: str
    verdict: str
    mesh: SegmentedMesh
    unit: Unit
    rotation: Float[np.ndarray, "3 3"]
    cloud: PointCloud | None = None
    depth: tuple[Picture, Sequence[str]] | None = None
    colorings: Mapping[str, Coloring] = field(default_factory=dict)
    ask: Callable[[Float[np.ndarray, "n 3"]], Probed] | None = None
    is_doubtful: bool = False
    picks: Picks | None = None
    joints: str = ""

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Box of surfaces and points."""
        clouds = [] if self.cloud is None else [self.cloud.points]
        return box_of(np.concatenate([*clouds, *(segment.vertices for segment in self.mesh.segments)]))


def open_answer(answer: Answer, port: int, picks: Picks | None = None) -> OpenPage:
    """Open the page of an answer, which a click may have answered again.

    Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
    """
    import_viser()
    return _opened(replace(content_of_answer(answer), picks=picks), port)


def open_files(path: Path, port: int) -> OpenPage:
    """Open the page of a GLB file, or of a folder of results by its files alone.

    Raises as ``open_answer`` and ``content_of_files`` do.
    """
    return _opened(content_of_files(path), port)


def _opened(content: Content, port: int) -> OpenPage:
    server = start_server(port)
    ResultPage(server, content)
    return OpenPage(server)


def content_of_answer(answer: Answer) -> Content:
    """Content of an answer; raises ``ValueError`` where there are no surfaces."""
    frame, mesh, cloud = answer.seen.frame, answer.reconstruction.surfaces, answer.reconstruction.reading.cloud
    unit = Unit(frame.unit_m)
    radii = radii_of(answer.registered)
    made_with = "no weights" if answer.model is None else f"weights {answer.model.name or 'of this program'}"
    depth = None if frame.depth is None else (depth_picture(frame.depth), depth_ends(frame.depth, unit))
    colorings: dict[str, Coloring] = {}
    if answer.reconstruction.code is not None:
        colorings["confidence"] = lambda: _painted(confidence(mesh, partial(ask_network, answer)), CONFIDENCE)
    colorings |= _measured_colorings(mesh, unit, cloud, radii)
    return Content(
        title=frame.source,
        facts=f"{len(answer.seen.cloud):,} points · {made_with}",
        verdict=source_of(answer),
        mesh=mesh,
        unit=unit,
        rotation=to_viewer_of(frame),
        cloud=cloud,
        depth=depth,
        colorings=colorings,
        ask=partial(probe_answer, answer),
        joints=joint_table(measure_joints(answer)),
    )


def are_files(path: Path) -> bool:
    """Whether a path names a GLB file, a folder of results, or the state in one."""
    if is_glb(path) or path.name == STATE:
        return True
    return any((path / name).is_file() for name in (STATE, WRITERS["glb"].file, WRITERS["json"].file))


def content_of_files(path: Path) -> Content:
    """Content of a GLB file, or of a folder of results: surfaces, observed points, depth image and verdict.

    Raises ``FileNotFoundError`` where the surfaces are not there, and ``ValueError`` for a damaged file.
    """
    folder = path.parent if path.name == STATE else path
    if is_glb(path):
        scene = read_glb(path)
        report = None
        # glTF's metres; a file of ours has the same number where the unit of its input was not known
        unit = UNKNOWN if scene.is_ours and scene.unit_m == 1.0 else Unit(scene.unit_m)
    else:
        surfaces = folder / WRITERS["glb"].file
        if not surfaces.is_file():
            raise FileNotFoundError(
                f"{folder} has no {surfaces.name}, which the page of a result shows: write it again with --formats glb"
            )
        scene = read_glb(surfaces)
        report = read_report(folder / REPORT)
        scene = replace(scene, mesh=_nested(scene.mesh, folder / WRITERS["json"].file))
        unit = Unit(scene.unit_m) if report is not None and report.unit_known else UNKNOWN
    cloud = None if report is None else report.cloud
    colorings: dict[str, Coloring] = {}
    if any(colors is not None for colors in scene.colors):
        colorings[VERTEX] = lambda: (_vertex_colors(scene), None)
    colorings |= _measured_colorings(scene.mesh, unit, cloud, scene.radii)
    shown = Content(
        title=path.name,
        facts=_facts(scene, unit, None if report is None else report.count),
        verdict="",
        mesh=scene.mesh,
        unit=unit,
        rotation=scene.rotation,
        cloud=cloud,
        colorings=colorings,
        ask=partial(probe_surfaces, Solids(scene.mesh), scene.radii) if scene.is_ours else None,
    )
    if report is None:
        return shown
    return replace(
        shown,
        title=report.title,
        verdict=report.verdict,
        depth=None if report.depth is None else (report.depth, report.ends),
        is_doubtful=report.level == "no",
        joints=joint_table(report.joints),
    )


def _nested(mesh: SegmentedMesh, summary: Path) -> SegmentedMesh:
    """The mesh with the nesting of its segments, which a GLB file does not say, where the summary does."""
    try:
        pairs = json.loads(summary.read_bytes())["nested"]
        return SegmentedMesh(mesh.segments, tuple((inner, outer) for inner, outer in pairs))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return mesh


def _facts(scene: GlbScene, unit: Unit, points: int | None) -> str:
    sides = np.ptp(scene.mesh.bounds, axis=0) * unit.length_factor
    size = f"{' x '.join(rounded(float(side)) for side in sides)} {unit.length_name}"
    parts = counted(len(scene.mesh.segments), "segment" if scene.is_ours else "part")
    faces = sum(len(segment.faces) for segment in scene.mesh.segments)
    return " · ".join([*([] if points is None else [f"{points:,} points"]), parts, f"{faces:,} faces", size])


def round_length(most: float, unit: Unit) -> tuple[float, str]:
    """Greatest length of 1, 2 or 5 times a power of ten up to ``most``, and its words: in mm, cm, m, or units."""
    metres = unit.metres or 1.0
    power = 10.0 ** np.floor(np.log10(most * metres))
    length = float(max(k * power for k in (1, 2, 5) if k * power <= most * metres))
    names = ((1000, "mm"), (100, "cm"), (1, "m")) if unit.metres else ((1, "units"),)
    factor, name = next((each for each in names if each[0] * length < 100), names[-1])
    return length / metres, f"{factor * length:g} {name}"


# --- colours ----------------------------------------------------------------------------------------------------------


def _painted(values: Sequence[Float[np.ndarray, " _"]], scale: ColorScale) -> tuple[Colors, ColorScale]:
    return [scale.colors(value) for value in values], scale


def _measured_colorings(
    mesh: SegmentedMesh, unit: Unit, cloud: PointCloud | None, radii: Radii | None
) -> dict[str, Coloring]:
    """Colourings by the distance to what was observed, and by how sure the surfaces are."""
    name = f" {unit.length_name}"

    def by_distance() -> tuple[Colors, ColorScale]:
        assert cloud is not None
        values = [value * unit.length_factor for value in observed_distance(mesh, cloud.points)]
        return _painted(values, distance_scale(values, name))

    def by_radius() -> tuple[Colors, ColorScale]:
        assert radii is not None
        scaled = radii.scaled(unit.length_factor)
        return _painted(scaled.vertices, radius_scale(scaled, name))

    result: dict[str, Coloring] = {} if cloud is None else {"distance": by_distance}
    return result if radii is None else {**result, SURE: by_radius}


def _vertex_colors(scene: GlbScene) -> Colors:
    pairs = zip(scene.mesh.segments, scene.colors, strict=True)
    return [np.tile(np.array(s.color, dtype=np.uint8), (len(s.vertices), 1)) if c is None else c for s, c in pairs]


# --- page -------------------------------------------------------------------------------------------------------------


class ResultPage:
    """Page that shows a ``Content`` and answers clicks, check boxes and sliders until its server stops."""

    def __init__(self, server: Any, content: Content) -> None:
        self.server, self.content = server, content
        self._drawing, self._answering = threading.Lock(), threading.Lock()
        self._known_colors: dict[str, tuple[Colors, ColorScale | None]] = {}
        self.stage = Display(server, content.bounds, content.rotation.T @ [0.0, 1.0, 0.0])
        self.layer = SegmentLayer(self.stage, "/segments")
        self._build()
        self._draw()

    def _build(self) -> None:
        gui, content = self.server.gui, self.content
        self.heading, self.verdict, self.hint = (gui.add_html("") for _ in range(3))
        self._say()
        with self.stage.add_panel("Show"):
            self._fill(gui, content)

    def _say(self) -> None:
        """What a phone shows below the object, and a wide page at its side."""
        content = self.content
        self.heading.content = heading(content.title, content.facts)
        verdict = content.verdict and message(content.verdict, bad=content.is_doubtful)
        self.verdict.content = verdict + (content.joints and f'<div style="{BOX}">{content.joints}</div>')
        self.hint.content = self._add_axes()

    def _fill(self, gui: Any, content: Content) -> None:
        colorings = (SEGMENT, *content.colorings)
        first = VERTEX if VERTEX in colorings else SEGMENT
        self.coloring = gui.add_dropdown("Colour", colorings, initial_value=first, visible=len(colorings) > 1)
        self.legend = gui.add_html("", visible=False)
        self.coloring.on_update(lambda _: self._draw())
        self.controls = SegmentControls(gui, content.mesh, self._draw)
        if content.cloud is not None:
            self.points = PointLayer(self.stage)
            self.points.show(content.cloud)
            # white points would hide the colours that are looked at
            self.coloring.on_update(lambda _: setattr(self.points.box, "value", self.coloring.value == SEGMENT))
        if content.picks is not None:
            self.picking = gui.add_checkbox("Find what I click", False)
            self.picking.on_update(lambda _: self._show_points())
        toward = content.rotation.T @ [0.0, 0.0, 1.0]
        self._look = self.stage.add_views(lambda: toward, lambda: self.content.bounds)
        if content.ask is not None:
            self._build_probe()
        if content.depth is not None:
            with gui.add_folder("Depth image"):
                gui.add_image(enlarged(content.depth[0]), format="png")
                if len(content.depth[1]) == 2:
                    gui.add_html(message("bright: {}; dark: {}".format(*content.depth[1])))

    def _add_axes(self) -> str:
        """Draw the axes of the input's frame, and return what to do on the page, and whose axes they are."""
        content, (low, high) = self.content, self.content.bounds
        length, text = round_length(float((high - low).max()) / 3, content.unit)
        self.stage.add_axes(low, length, text)
        is_camera = np.allclose(content.rotation, GLTF_CAMERA_ROTATION)
        whose = "the camera's: x right, y down, z away" if is_camera else "the input's"
        return hint(f"axes: {whose}; each {text} long")

    def _build_probe(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Probe"):
            self.probing = gui.add_checkbox("ask at a point", False)
            self.facts = gui.add_html(message("Click a surface, or drag the arrows of the probe."))
        self.gizmo = self.server.scene.add_transform_controls(
            "/probe", scale=0.35, disable_rotations=True, depth_test=False, visible=False
        )
        self.gizmo.on_update(lambda _: self.probe(self.stage.back(np.array(self.gizmo.position))))
        self.probing.on_update(lambda _: self._switch_probe())
        self.server.scene.on_click()(self._clicked)
        self._arrow: Any = None

    def _draw(self) -> None:
        """Callbacks run in several threads; one of them draws at a time."""
        with self._drawing, self.server.atomic():
            name = self.coloring.value
            if name != SEGMENT and name not in self._known_colors:
                self._known_colors[name] = self.content.colorings[name]()
            colors, scale = (None, None) if name == SEGMENT else self._known_colors[name]
            self.legend.content = "" if scale is None else color_bar(scale)
            self.legend.visible = scale is not None
            self.controls.name_colors(scale is None)
            self.layer.show(self.content.mesh, self.controls, colors)

    # --- picking ------------------------------------------------------------------------------------------------------

    def _show_points(self) -> None:
        """Show all that the camera saw where the object is picked in it, else the object's points."""
        picks, cloud = self.content.picks, self.content.cloud
        shown = picks[0] if picks is not None and self.picking.value else cloud
        if shown is not None:
            self.points.show(shown)

    def answer_at(self, point: Float[np.ndarray, "3"]) -> None:
        """Show the answer at a point that the camera saw, or why there is none; clicks meanwhile do nothing."""
        picks = self.content.picks
        if picks is None or not self._answering.acquire(blocking=False):
            return
        try:
            self.verdict.content = message("looking there; the first time takes longest")
            self.content = replace(content_of_answer(picks[1](point)), picks=picks)
            self._known_colors.clear()
            self.coloring.options, self.coloring.value = (SEGMENT, *self.content.colorings), SEGMENT
            self.picking.value = False
            self._look("front")
            self._draw()
            self._say()
        except Exception as error:  # whatever it is, the page must live on and say it
            self.verdict.content = message(words_of(error), bad=True)
        finally:
            self._answering.release()

    # --- probing ------------------------------------------------------------------------------------------------------

    def _clicked(self, event: Any) -> None:
        origin, direction = (np.array(ray, dtype=float) for ray in (event.ray_origin, event.ray_direction))
        if self.content.picks is not None and self.picking.value:
            self.answer_at(nearest_to_ray(self.content.picks[0].points, self.stage.back(origin), direction))
            return
        point = first_point(self.content.mesh, self.stage.back(origin), direction, self.controls.visible())
        if point is not None:
            self.move_probe(point)
            self.probing.value = True

    def _switch_probe(self) -> None:
        if self.probing.value and self._arrow is None:
            self.move_probe(self.stage.center)
        self._show_probe(bool(self.probing.value))

    def _show_probe(self, is_shown: bool) -> None:
        self.gizmo.visible = is_shown
        if self._arrow is not None:
            self._arrow.visible = is_shown

    def move_probe(self, point: Float[np.ndarray, "3"]) -> None:
        """Show the probe at a point of the input's frame."""
        self.gizmo.position = tuple(self.stage.place(point))
        self._show_probe(True)
        self.probe(point)

    def probe(self, point: Float[np.ndarray, "3"]) -> None:
        """Say what is known of a point of the input's frame, and draw the way to the nearest surface."""
        assert self.content.ask is not None
        answer = self.content.ask(point[None])
        mesh = self.content.mesh
        names, colors = ("empty space", *mesh.names), (EMPTY_COLOR, *mesh.colors)
        self.facts.content = probe_html(answer, names, colors, point, self.content.unit)
        distance = float(answer.distance[0])
        direction = answer.direction[0]
        if np.isnan(distance) or np.isnan(direction).any():
            return
        start = self.stage.place(point)
        end = start + max(abs(distance) * self.stage.scale, 0.03) * direction
        self._arrow = self.server.scene.add_arrows(
            "/arrow",
            np.stack([start, end])[None].astype(np.float32),
            colors[int(answer.label[0])],
            shaft_radius=0.008,
            head_radius=0.022,
            head_length=min(0.06, 0.5 * float(np.linalg.norm(end - start))),
        )
