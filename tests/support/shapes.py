"""Small closed meshes with known answers, for the tests of the forward path."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from numpy.random import default_rng

from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh


def segment(mesh: trimesh.Trimesh, name: str = "part", color: int = 0) -> Segment:
    return Segment(name, PALETTE[color], np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def box(low: tuple[float, ...], high: tuple[float, ...], name: str = "box", color: int = 0) -> Segment:
    return segment(trimesh.creation.box(bounds=[low, high]), name, color)


def ball(center: tuple[float, ...], radius: float, name: str = "ball", color: int = 0, level: int = 4) -> Segment:
    mesh = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    mesh.apply_translation(center)
    return segment(mesh, name, color)


def knobbly_torus(seed: int, name: str = "torus", color: int = 0) -> Segment:
    """Neither convex nor simply connected, in no special position."""
    rng = default_rng(seed)
    mesh = trimesh.creation.torus(major_radius=3.0, minor_radius=1.2, major_sections=40, minor_sections=24)
    waves = rng.normal(size=(3, 3))
    points = mesh.vertices + 0.12 * np.sin(mesh.vertices @ waves.T + rng.uniform(0, 6, size=3)) @ rng.normal(
        size=(3, 3)
    )
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    return Segment(name, PALETTE[color], points @ turn.T, np.array(mesh.faces, np.int64))


def write_model(path: Path, parts: Mapping[str, Segment]) -> Path:
    """Write a model file whose nodes are these parts."""
    scene = trimesh.Scene()
    for name, part in parts.items():
        scene.add_geometry(trimesh.Trimesh(part.vertices, part.faces), node_name=name, geom_name=name)
    scene.export(path)
    return path


def one(part: Segment) -> SegmentedMesh:
    return SegmentedMesh((part,))
