"""A deformed silicone liver predicted from a part of its surface: elastic modes and others against its CT.

    python benchmarks/phantom.py [FOLDER] [--cells C] [--modes K]

FOLDER (else ``MEREO_ASSETS``/liver_phantom) holds STL files, millimetres, +y down: the surface before
(``initial-surface``) and after (``DeformedSurfaceFromCT``), what a fit sees of it, A from CT
(``PartialDeformedSurfaceFromCT``) and B from an endoscope (``intraoperative_auto2``), and a rival's answer to B
(``pbsm_from_endoscope``); and tetrahedra before, ``InitialLowResolutionVolumeModel.vtk``.

Each row: IoU with the truth on 64^3 nodes; distance to the answer of the true surface that is 6 mm or more from A,
median / 95 %; change of volume; seconds of the fit. All methods share the data term, and the truth is read by ``Truth``
alone. The cases are what is known of the pose: nothing, that the lowest quarter stays where it was, or that all of the
solid stays near. That, the settings of ``FitConfig`` and ``MOTION`` were chosen with these figures in view, see
docs/experiments/066.md.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import igl
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from mereo.deformation.elastic import ElasticSolid, Material, build_lattice, find_modes, scale_modes
from mereo.deformation.tetrahedral import Tetrahedra
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.vtk_frames import read_vtk_frames

MOTION = 0.2
"""Root mean square displacement of the prior, in half longest sides, as all shares of ``FitConfig``."""

FACE_PLACES = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6
"""Barycentric places at which a face is compared with the cloud."""

NOISE = {"A": 0.01, "B": 0.05}

Points = tuple[np.ndarray, np.ndarray]
"""Positions and unit normals, [p, 3] each."""


# --- fit --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FitConfig:
    """How a surface is fitted; lengths are shares of half the rest box's longest side.

    Attributes:
        noise: standard deviation of a measured point across the surface.
        start, cooling, steps: first, wide standard deviation, its factor in each step, and the number of steps.
        independent: share of the measured points that count; neighbours err alike.
        tangent: weight of a pair's distance along the surface, of that across it.
        normal_length: distance that a difference of normals by 1 is worth in the search for pairs.
        robust: residual, in standard deviations, at which a pair has lost three quarters of its weight.
        hold: how far held points are from the given pose, root mean square; None where the pose is unknown. It grows
            as the cloud's standard deviation narrows, so that a wrong one does not decide the pairs.
    """

    noise: float = 0.01
    start: float = 0.15
    cooling: float = 0.85
    steps: int = 40
    independent: float = 0.1
    tangent: float = 0.02
    normal_length: float = 0.1
    robust: float = 2.5
    hold: float | None = None


@dataclass(frozen=True, eq=False)
class SurfaceModel:
    """Surface with the states ``R (vertices + modes z) + t``, z ~ N(0, 1), and points of the solid that may be held."""

    vertices: np.ndarray
    faces: np.ndarray
    modes: np.ndarray
    held: np.ndarray
    held_modes: np.ndarray

    def first(self, count: int) -> "SurfaceModel":
        return replace(self, modes=self.modes[..., :count], held_modes=self.held_modes[..., :count])

    def lowest_quarter(self) -> "SurfaceModel":
        low = self.held[:, 1] > np.quantile(self.held[:, 1], 0.75)
        return replace(self, held=self.held[low], held_modes=self.held_modes[low])


def fit_surface(model: SurfaceModel, cloud: Points, config: FitConfig) -> np.ndarray:
    """Vertices of the state that explains a cloud, from the given pose: Gauss-Newton, from wide to narrow."""
    points, normals = cloud
    half = float(np.ptp(model.vertices, axis=0).max()) / 2
    k, center = model.modes.shape[2], model.held.mean(axis=0)
    rest, held = model.vertices - center, model.held - center
    R, t, z = np.eye(3), center.copy(), np.zeros(k)
    moved = model.vertices
    for step in range(config.steps):
        sigma = half * max(config.noise, config.start * config.cooling**step)
        place, normal, corners, weights = match(moved, model.faces, cloud, half * config.normal_length)
        across = normal + normals
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        error = points - place
        worth = 1 / (1 + ((error**2).sum(axis=1) / (config.robust * sigma) ** 2)) ** 2
        worth *= np.clip((normal * normals).sum(axis=1), 0, 1) * config.independent / sigma**2
        metric = (1 - config.tangent) * across[:, :, None] * across[:, None] + config.tangent * np.eye(3)
        J = jacobian(place - t, R, np.einsum("pc,pcik->pik", weights, model.modes[corners]))
        A, b = normal_equations(J, worth[:, None, None] * metric, error)
        A[6:, 6:] += np.eye(k)
        b[6:] -= z
        if config.hold is not None:
            now = (held + model.held_modes @ z) @ R.T
            late = (half * config.noise / sigma) ** 2
            stiffness = late * np.eye(3) / (len(held) * (half * config.hold) ** 2)
            more = normal_equations(jacobian(now, R, model.held_modes), stiffness[None], held + center - t - now)
            A, b = A + more[0], b + more[1]
        A[:6, :6] += 1e-12 * np.trace(A[:6, :6]) * np.eye(6)
        change = np.linalg.solve(A, b)
        R, t, z = Rotation.from_rotvec(change[:3]).as_matrix() @ R, t + change[3:6], z + change[6:]
        before, moved = moved, (rest + model.modes @ z) @ R.T + t
        if sigma == half * config.noise and np.abs(moved - before).max() < 5e-4 * half:
            break
    return moved


def normal_equations(J: np.ndarray, metric: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    weighted = np.matmul(metric, J).reshape(-1, J.shape[2])
    return J.reshape(-1, J.shape[2]).T @ weighted, weighted.T @ error.ravel()


def match(
    vertices: np.ndarray, faces: np.ndarray, cloud: Points, normal_length: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Place, normal, corners and barycentric weights of what is nearest on the surface, in place and direction."""
    normal = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA)
    place = np.einsum("sc,fci->fsi", FACE_PLACES, vertices[faces]).reshape(-1, 3)
    normal = np.einsum("sc,fci->fsi", FACE_PLACES, np.nan_to_num(normal)[faces]).reshape(-1, 3)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    points, normals = cloud
    _, near = cKDTree(np.hstack([place, normal_length * normal])).query(np.hstack([points, normal_length * normals]))
    return place[near], normal[near], faces[near // 3], FACE_PLACES[near % 3]


def jacobian(arm: np.ndarray, R: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Derivatives [p, 3, 6 + k] of places by a turn about the origin of ``arm``, a shift, and the coefficients."""
    x, y, z = arm.T
    result = np.zeros((len(arm), 3, 6 + basis.shape[2]))
    result[:, 0, 1], result[:, 0, 2] = z, -y
    result[:, 1, 0], result[:, 1, 2] = -z, x
    result[:, 2, 0], result[:, 2, 1] = y, -x
    result[:, :, 3:6] = np.eye(3)
    result[:, :, 6:] = np.matmul(R, basis)
    return result


# --- models -----------------------------------------------------------------------------------------------------------


def elastic_model(solid: ElasticSolid, modes: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> SurfaceModel:
    mass = solid.mass
    held = np.random.default_rng(0).choice(len(mass), 1600, p=mass / mass.sum())
    moved = (solid.mesh.embed(vertices) @ modes.reshape(len(modes), -1)).reshape(len(vertices), 3, -1)
    return SurfaceModel(vertices, faces, moved, solid.mesh.nodes[held], modes[held])


def gaussian_process(solid: ElasticSolid, points: np.ndarray, half: float, count: int = 34) -> np.ndarray:
    """Modes [p, 3, 3 count] of the kernel 100 mm / 20 mm + 50 mm / 8 mm of this liver, by Nystroem's method."""
    mass = solid.mass
    centers = solid.mesh.nodes[np.unique(np.random.default_rng(0).choice(len(mass), 800, p=mass / mass.sum()))]

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squared = cdist(a, b, "sqeuclidean")
        lengths = ((0.97 * half, 0.19 * half), (0.48 * half, 0.077 * half))
        return sum(motion**2 * np.exp(-squared / (2 * length**2)) for length, motion in lengths)

    values, vectors = np.linalg.eigh(kernel(centers, centers))
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    basis = kernel(points, centers) @ vectors / np.sqrt(values)
    return np.einsum("pk,ij->pikj", basis, np.eye(3)).reshape(len(points), 3, 3 * count)


def models(folder: Path, rest: trimesh.Trimesh, cells: int, count: int) -> dict[str, SurfaceModel]:
    vertices, faces = np.asarray(rest.vertices, dtype=float), np.asarray(rest.faces, dtype=np.int64)
    half, material = float(np.ptp(vertices, axis=0).max()) / 2, Material()
    start = time.perf_counter()
    lattice = build_lattice(SegmentedMesh((Segment("liver", (0, 114, 178), vertices, faces),)), cells)
    made = time.perf_counter() - start
    values, modes = find_modes(lattice, count, material)
    spent = time.perf_counter() - start
    print(f"lattice of {len(lattice.mesh.nodes)} nodes: {made:.1f} s, with {count} modes {spent:.1f} s")
    volume = read_vtk_frames([folder / "InitialLowResolutionVolumeModel.vtk"])
    given = Tetrahedra(volume.points[0], volume.tetrahedra)
    follows = ElasticSolid(given, np.ones(len(given.elements)))
    start = time.perf_counter()
    given_values, given_modes = find_modes(follows, count, Material(poisson=0.45))
    print(f"given tetrahedra, {len(given.nodes)} nodes: {count} modes {time.perf_counter() - start:.1f} s")

    def elastic(power: float) -> SurfaceModel:
        return elastic_model(follows, scale_modes(given_values, given_modes, MOTION * half, power), vertices, faces)

    coarse, exact = elastic_model(lattice, scale_modes(values, modes, MOTION * half), vertices, faces), elastic(2)
    smooth, held_smooth = (gaussian_process(follows, points, half) for points in (vertices, exact.held))
    return {
        "rigid": exact.first(0),
        "Gaussian process": replace(exact, modes=smooth, held_modes=held_smooth),
        f"elastic, lattice {cells}, p = 2": coarse,
        **{f"elastic, lattice {cells}, first {k}": coarse.first(k) for k in (30, 60) if k < count},
        "elastic, tetrahedra, p = 1": elastic(1),
        "elastic, tetrahedra, p = 2": exact,
        "elastic, tetrahedra, p = 3": elastic(3),
    }


# --- truth ------------------------------------------------------------------------------------------------------------


class Truth:
    """The surface after, from CT."""

    def __init__(self, folder: Path, rest: trimesh.Trimesh) -> None:
        after, part = (load(folder, name) for name in ("DeformedSurfaceFromCT", "PartialDeformedSurfaceFromCT"))
        self.vertices, self.faces = np.asarray(after.vertices), np.asarray(after.faces, dtype=np.int64)
        self.volume = float(rest.volume)
        points = np.asarray(trimesh.sample.sample_surface(after, 6000, seed=0)[0])
        self.hidden = points[cKDTree(np.asarray(part.vertices)).query(points)[0] > 6.0]

    def line(self, vertices: np.ndarray, faces: np.ndarray) -> str:
        corners = np.concatenate([vertices, self.vertices])
        axes = np.linspace(corners.min(axis=0), corners.max(axis=0), 64).T
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        mine, true = (
            igl.fast_winding_number(np.ascontiguousarray(v), f, nodes) > 0.5
            for v, f in ((vertices, faces), (self.vertices, self.faces))
        )
        away = np.sqrt(igl.point_mesh_squared_distance(self.hidden, np.ascontiguousarray(vertices), faces)[0])
        volume = trimesh.Trimesh(vertices, faces, process=False).volume / self.volume - 1
        iou = (mine & true).sum() / (mine | true).sum()
        median, most = np.median(away), np.percentile(away, 95)
        return f"{iou:.3f} | {median:5.2f} / {most:5.2f} | {100 * volume:+.1f}"


def load(folder: Path, name: str) -> trimesh.Trimesh:
    return trimesh.load(folder / f"{name}.stl")


def measured(folder: Path, which: str) -> Points:
    """2,500 points of an input; normals towards the camera, which is above."""
    part = load(folder, {"A": "PartialDeformedSurfaceFromCT", "B": "intraoperative_auto2"}[which])
    points, normals = np.asarray(part.vertices), np.asarray(part.vertex_normals)
    chosen = np.random.default_rng(0).permutation(len(points))[:2500]
    return points[chosen].copy(), normals[chosen] * (-1 if np.median(normals[:, 1]) > 0 else 1)


CASES: dict[str, tuple[float | None, Callable[[SurfaceModel], SurfaceModel]]] = {
    "pose unknown": (None, lambda model: model),
    "underside held": (0.01, SurfaceModel.lowest_quarter),
    "pose given": (0.03, lambda model: model),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(os.environ.get("MEREO_ASSETS", "")) / "liver_phantom"
    )
    parser.add_argument("--cells", type=int, default=16)
    parser.add_argument("--modes", type=int, default=100)
    arguments = parser.parse_args()
    rest, rival = (load(arguments.folder, name) for name in ("initial-surface", "pbsm_from_endoscope"))
    truth, candidates = Truth(arguments.folder, rest), models(arguments.folder, rest, arguments.cells, arguments.modes)
    print("| input | known | method | IoU | hidden, mm | volume, % | s |\n|---|---|---|---|---|---|---|")
    for which, name, mesh in (("", "identity", rest), ("B", "rival's file", rival)):
        row = truth.line(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
        print(f"| {which} | | {name} | {row} | |")
    for which, noise in NOISE.items():
        cloud = measured(arguments.folder, which)
        for case, (hold, part) in CASES.items():
            for name, model in candidates.items():
                start = time.perf_counter()
                vertices = fit_surface(part(model), cloud, FitConfig(noise=noise, hold=hold))
                spent = time.perf_counter() - start
                print(f"| {which} | {case} | {name} | {truth.line(vertices, model.faces)} | {spent:.1f} |", flush=True)


if __name__ == "__main__":
    main()
