"""Simulated states: how good the interior estimate from surfaces alone is, and what states cost.

    python benchmarks/simulated_states.py [FRAMES]

The truth is the scene liver-simulated, whose tetrahedra move every interior point. Its surfaces alone, as a simulator
without tetrahedra would export them, give the estimate. The rival moves a point like the closest point of the surface.
"""

import sys
import time
from pathlib import Path

import numpy as np

from mereo.deformation.maps import invert, jacobian_determinant
from mereo.deformation.tetrahedral import Surface, SurfaceMap
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.scenes.recorded_states import States, SurfaceFrames, load_states
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import synthesize
from mereo_objects._liver_parts import MM

STATES = Path(__file__).parents[1] / "src/mereo/states/liver.npz"
POINTS = 1500


def interior(rest: SegmentedMesh, index: int, rng: np.random.Generator) -> np.ndarray:
    low, high = rest.segments[index].bounds
    draws = rng.uniform(low, high, (20 * POINTS, 3))
    return draws[Solids(rest).inside(index, draws)][:POINTS]


def rms(offsets: np.ndarray) -> float:
    """Of lengths, millimetres."""
    return float(np.sqrt((offsets**2).sum(axis=-1).mean()) / MM)


def accuracy(rest: SegmentedMesh, states: States, frames: int) -> None:
    print("segment       moved (rms)   estimate (rms, 99 %)   closest point (rms)   least Jacobian   undone   ms/state")
    rng = np.random.default_rng(0)
    for index, part in enumerate(rest.segments):
        points = interior(rest, index, rng)
        surface = Surface(part.vertices, part.faces)
        moved, errors, rivals, least, undone, seconds = [], [], [], [], [], 0.0
        for frame in np.linspace(0, states.end - 1, frames).astype(int):
            truth = states.frames.deformations(int(frame))[index]
            vertices, there = truth(part.vertices), truth(points)
            start = time.perf_counter()
            estimate = SurfaceMap(surface, vertices)
            here = estimate(points)
            seconds += time.perf_counter() - start
            moved.append(there - points)
            errors.append(here - there)
            nearest = Solids(SegmentedMesh((part,))).nearest(points)
            rivals.append(truth(nearest.point) - nearest.point + points - there)
            least.append(jacobian_determinant(estimate, points).min())
            undone.append(invert(estimate, here, points + 0.1)[1].mean())
        high = np.percentile(np.linalg.norm(np.concatenate(errors), axis=1), 99) / MM
        print(
            f"{part.name:12s} {rms(np.concatenate(moved)):10.2f} mm {rms(np.concatenate(errors)):11.2f}, {high:.2f} mm "
            f"{rms(np.concatenate(rivals)):18.2f} mm {min(least):14.2f} {np.mean(undone):10.2%} "
            f"{1e3 * seconds / frames:8.1f}"
        )


def speed(scenes: list[Scene], examples: int = 12) -> None:
    for scene in scenes:
        synthesize(scene, GenerateConfig(), example_rng(0, 0))
        start = time.perf_counter()
        work = time.process_time()
        for index in range(examples):
            synthesize(scene, GenerateConfig(), example_rng(1, index))
        wall, cpu = time.perf_counter() - start, time.process_time() - work
        print(f"{scene.name:28s} {examples / wall:6.1f} examples/s, {examples / cpu:6.1f} by CPU time")


def main(frames: int = 20) -> None:
    scene = load_scene("liver-simulated")
    rest, states = scene.rest, load_states(STATES, scene.rest, scale=MM).training
    accuracy(rest, states, frames)
    maps = [states.frames.deformations(frame) for frame in range(frames)]
    vertices = tuple(
        np.stack([deformations[index](part.vertices) for deformations in maps])
        for index, part in enumerate(rest.segments)
    )
    surfaces = SurfaceFrames(tuple(Surface(s.vertices, s.faces) for s in rest.segments), vertices, 1.0, np.zeros(3))
    alone = Scene("its surfaces alone", rest, States(surfaces, 0, frames).sample, scene.workspace)
    speed([scene, alone, load_scene("liver")])


if __name__ == "__main__":
    main(*(int(value) for value in sys.argv[1:2]))
