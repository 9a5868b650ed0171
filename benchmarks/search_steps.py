"""See how an object is found, step by step, in a frame that shows a half of it.

    python benchmarks/search_steps.py [--scene rope] [--output search_steps.png]

Pictures, from left to right: what each line of sight says (orange met the object, blue went past it, of red nothing is
known); a start; the best pose after rigid steps; the best state after it was bent by few points; the fit; and the fit
from behind, with the hidden half. Observed points are black.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from occluded_views import occlude

from mereo.fitting.config import FitConfig
from mereo.fitting.modes import bend_by_few
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.search import FITTED, SCREENING, screen_poses, search
from mereo.reconstruction.observation import Observation, find_object
from mereo.scenes.random_states import kept_model
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.visualization.contact_sheets import save_png
from mereo.visualization.renderer import Viewpoint, shaded_canvas

SIDE = 300
"""Pixels along each side of a picture."""

BLACK = (0.05, 0.05, 0.05)


@dataclass(frozen=True)
class Options:
    """Options of the example.

    Attributes:
        scene: built-in scene that is looked for.
        hidden: share of the object's pixels that are hidden.
        index: of the view.
        output: the picture to write.
    """

    scene: str = "rope"
    hidden: float = 0.4
    index: int = 0
    output: Path = Path("search_steps.png")


def main(options: Options) -> None:
    """Search one occluded view, and draw the steps."""
    scene = load_scene(options.scene)
    settings = GenerateConfig(image_size=192)
    view = sample_view(scene.for_seed(1), settings, example_rng(1, options.index))
    cut = occlude(view, "screen", options.hidden, np.random.default_rng(options.index), settings)
    seen = find_object(cut.frame())
    model = kept_model(scene)
    evidence = Evidence.of(seen.cloud.points, lines=seen.lines)
    problem = Problem(model, evidence, KNOWN_SCALE_STD, FitConfig())
    rigid = screen_poses(problem, SCREENING)
    bent = bend_by_few(problem, rigid, FITTED)
    found = search(problem)
    states = (rigid[-1], rigid[0], bent[0][1], found.best.posed)
    points = evidence.points
    front = Viewpoint.along(cut.mesh.bounds, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    back = Viewpoint.along(cut.mesh.bounds, (0.6, 0.3, -0.75), (0.0, -1.0, 0.0))
    tiles = [square(sight_picture(seen))]
    for posed, viewpoint in (*((state, front) for state in states), (states[-1], back)):
        canvas = shaded_canvas(model.mesh(posed.place(model.material(posed.z))), viewpoint, (SIDE, SIDE))
        canvas.draw_points(points, np.broadcast_to(BLACK, points.shape), 1.0)
        tiles.append(canvas.picture())
    save_png(options.output, np.concatenate(tiles, axis=1))
    print(f"{1 + len(found.others)} candidates explain the frame; wrote {options.output}")


def sight_picture(seen: Observation) -> np.ndarray:
    """Depth image in which lines of sight are orange where they met the object, blue past it, red where unknown."""
    depth = seen.frame.depth if seen.frame.whole is None else seen.frame.whole
    assert depth is not None
    measured = depth.depth[depth.valid]
    gray = np.zeros(depth.depth.shape)
    gray[depth.valid] = 255 * np.minimum(np.quantile(measured, 0.01) / measured, 1.0)
    picture = np.repeat(gray[:, :, None], 3, axis=2)
    kinds = (
        (seen.lines.past, (60, 130, 255)),
        (seen.lines.unknown, (225, 60, 60)),
        (seen.cloud.points, (255, 170, 40)),
    )
    for points, color in kinds:
        columns, rows = np.floor(depth.camera.project(points)).astype(np.int64).T
        inside = (rows >= 0) & (rows < depth.camera.height) & (columns >= 0) & (columns < depth.camera.width)
        pixels = rows[inside], columns[inside]
        picture[pixels] = 0.75 * np.array(color) + 0.25 * picture[pixels]
    return picture.astype(np.uint8)


def square(picture: np.ndarray) -> np.ndarray:
    """The middle of a picture, ``SIDE`` pixels along each side."""
    from PIL import Image

    height, width = picture.shape[:2]
    low = (width - min(height, width)) // 2, (height - min(height, width)) // 2
    image = Image.fromarray(picture).crop((*low, low[0] + min(height, width), low[1] + min(height, width)))
    return np.asarray(image.resize((SIDE, SIDE), Image.Resampling.NEAREST))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
