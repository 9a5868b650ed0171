"""A deformed silicone liver predicted from a part of its surface: ``mereo reconstruct`` and others against its CT.

    python benchmarks/phantom.py [FOLDER]

FOLDER (else ``MEREO_ASSETS``/liver_phantom) holds STL files, millimetres, +y down: the surface before
(``initial-surface``) and after (``DeformedSurfaceFromCT``), what a fit sees of it, A from CT
(``PartialDeformedSurfaceFromCT``) and B from an endoscope (``intraoperative_auto2``), and a rival's answer to B
(``pbsm_from_endoscope``).

Each row: IoU with the truth on 64^3 nodes; distance to the answer of the true surface that is 6 mm or more from A,
median / 95 %; share of that surface within the 95 % radius of the answer's nearest vertex; change of volume; seconds.
``mereo`` runs as a user runs it, on the STL files themselves, which it reads as surfaces that no single camera saw: the
whole command, with what it loads and writes. It knows of the pose: nothing ("search"), roughly what it is ("pose
given"), or that and that the lowest quarter did not move ("underside held"). The others start from the given pose:
rigid and Gaussian process with the pairs of ``match``; coherent point drift by pycpd, where that is installed. The
settings of the Gaussian process and its fit were chosen with these figures in view (docs/experiments/066.md), those of
mereo partly too (docs/experiments/068.md).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import igl
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import mereo

FACE_PLACES = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6
"""Barycentric places at which a face is compared with the cloud."""

NOISE = {"A": 0.01, "B": 0.05}

Points = tuple[np.ndarray, np.ndarray]
"""Positions and unit normals, [p, 3] each."""

# --- mereo ------------------------------------------------------------------------------------------------------------

INPUTS = {"A": "PartialDeformedSurfaceFromCT", "B": "intraoperative_auto2"}

SCENE = """\
name: phantom
units: mm
segments:
  - name: liver
    file: {surface}
camera:
  aperture: 360
deformations:
  - type: elastic
"""

HELD = """\
    held:
      - center: [0, {level}, 0]
        direction: [0, 1, 0]
"""


class Mereo:
    """The command line on one input at a time, in a folder of its own."""

    def __init__(self, folder: Path, rest: trimesh.Trimesh, place: Path) -> None:
        self.place = place
        level = quarter_level(rest)
        scene = SCENE.format(surface=json.dumps(str((folder / "initial-surface.stl").absolute())))
        (place / "free.yaml").write_text(scene)
        (place / "held.yaml").write_text(scene + HELD.format(level=f"{level:.1f}"))
        self.folder = folder.absolute()
        np.savetxt(place / "pose.txt", np.eye(4))

    def __call__(self, which: str, known: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Vertices, faces, 95 % radii of the vertices, and seconds."""
        frame = str(self.folder / f"{INPUTS[which]}.stl")
        scene = "held.yaml" if known == "underside held" else "free.yaml"
        given = [] if known == "search" else ["--initial-pose", "pose.txt"]
        command = ["reconstruct", frame, "--object", scene, "--unit-m", "0.001", *given]
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "mereo", *command, "--output", "out", "--formats", "ply", "--force"],
            cwd=self.place,
            capture_output=True,
            text=True,
        )
        if done.returncode not in (0, 3, 4):
            raise RuntimeError(done.stderr)
        seconds = time.perf_counter() - start
        surface = trimesh.load_mesh(self.place / "out" / "segments.ply", process=False)
        vertices = np.asarray(surface.vertices)
        radii = self.radii(vertices, frame, scene, None if known == "search" else np.eye(4))
        return vertices, np.asarray(surface.faces, dtype=np.int64), radii, seconds

    def radii(self, vertices: np.ndarray, frame: str, scene: str, pose: np.ndarray | None) -> np.ndarray:
        """95 % radii at the vertices of the last answer, which no file of a result has."""
        result = mereo.reconstruct(frame, str(self.place / scene), unit_m=0.001, initial_pose=pose)
        assert result.registered is not None
        radii = result.registered.radius95(vertices, at="camera")
        assert radii is not None
        return radii


def quarter_level(rest: trimesh.Trimesh) -> float:
    """Height (y) below which a quarter of the volume lies, the same in every run: what is held decides the answer."""
    low, high = rest.bounds
    points = np.random.default_rng(0).uniform(low, high, (200_000, 3))
    inside = igl.fast_winding_number(np.asarray(rest.vertices), np.asarray(rest.faces, dtype=np.int64), points) > 0.5
    return float(np.quantile(points[inside, 1], 0.75))


# --- others -----------------------------------------------------------------------------------------------------------


def rigid_modes(points: np.ndarray, half: float) -> np.ndarray:
    """No modes."""
    return np.zeros((len(points), 3, 0))


def gaussian_process(points: np.ndarray, half: float, count: int = 34) -> np.ndarray:
    """Modes [p, 3, 3 count] of the kernel 100 mm / 20 mm + 50 mm / 8 mm of this liver, by Nystroem's method."""
    centers = points[np.random.default_rng(0).choice(len(points), 800, replace=False)]

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squared = cdist(a, b, "sqeuclidean")
        lengths = ((0.97 * half, 0.19 * half), (0.48 * half, 0.077 * half))
        return sum(motion**2 * np.exp(-squared / (2 * length**2)) for length, motion in lengths)

    values, vectors = np.linalg.eigh(kernel(centers, centers))
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    basis = kernel(points, centers) @ vectors / np.sqrt(values)
    return np.einsum("pk,ij->pikj", basis, np.eye(3)).reshape(len(points), 3, 3 * count)


def fit_modes(vertices: np.ndarray, faces: np.ndarray, modes: np.ndarray, cloud: Points, noise: float) -> np.ndarray:
    """Vertices of the state that explains a cloud, from the given pose: Gauss-Newton, from wide to narrow.

    ``noise`` is a share of half the longest side; a tenth of the points count, as neighbours err alike.
    """
    points, normals = cloud
    half = float(np.ptp(vertices, axis=0).max()) / 2
    k = modes.shape[2]
    center = vertices.mean(axis=0)
    R = np.eye(3)
    t = center.copy()
    z = np.zeros(k)
    moved = vertices
    for step in range(40):
        sigma = half * max(noise, 0.15 * 0.85**step)
        place, normal, corners, weights = match(moved, faces, cloud, 0.1 * half)
        across = normal + normals
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        error = points - place
        worth = 1 / (1 + ((error**2).sum(axis=1) / (2.5 * sigma) ** 2)) ** 2
        worth *= np.clip((normal * normals).sum(axis=1), 0, 1) * 0.1 / sigma**2
        metric = worth[:, None, None] * (0.98 * across[:, :, None] * across[:, None] + 0.02 * np.eye(3))
        J = jacobian(place - t, R, np.einsum("pc,pcik->pik", weights, modes[corners]))
        weighted = np.matmul(metric, J).reshape(-1, 6 + k)
        flat = J.reshape(-1, 6 + k)
        A, b = flat.T @ weighted, weighted.T @ error.ravel()
        A[6:, 6:] += np.eye(k)
        b[6:] -= z
        A[:6, :6] += 1e-12 * np.trace(A[:6, :6]) * np.eye(6)
        change = np.linalg.solve(A, b)
        R, t, z = Rotation.from_rotvec(change[:3]).as_matrix() @ R, t + change[3:6], z + change[6:]
        moved = (vertices - center + modes @ z) @ R.T + t
    return moved


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


def coherent_point_drift(vertices: np.ndarray, cloud: Points) -> np.ndarray:
    """Vertices moved by pycpd's deformable registration of 1,500 of them; the others follow its kernel."""
    from pycpd import DeformableRegistration

    some = np.random.default_rng(0).choice(len(vertices), 1500, replace=False)
    middle = vertices.mean(axis=0)
    size = float(np.ptp(vertices, axis=0).max()) / 2
    source, target = (vertices - middle) / size, (cloud[0] - middle) / size
    drift = DeformableRegistration(X=target, Y=source[some], alpha=2000.0, beta=2.0, w=0.3, max_iterations=60)
    drift.register()
    return (
        source + np.exp(-cdist(source, source[some], "sqeuclidean") / (2 * drift.beta**2)) @ drift.W
    ) * size + middle


# --- truth ------------------------------------------------------------------------------------------------------------


class Truth:
    """The surface after, from CT."""

    def __init__(self, folder: Path, rest: trimesh.Trimesh) -> None:
        after, part = (load(folder, name) for name in ("DeformedSurfaceFromCT", "PartialDeformedSurfaceFromCT"))
        self.vertices, self.faces = np.asarray(after.vertices), np.asarray(after.faces, dtype=np.int64)
        self.volume = float(rest.volume)
        points = np.asarray(trimesh.sample.sample_surface(after, 6000, seed=0)[0])
        self.hidden = points[cKDTree(np.asarray(part.vertices)).query(points)[0] > 6.0]

    def line(self, vertices: np.ndarray, faces: np.ndarray, radii: np.ndarray | None = None) -> str:
        vertices = np.ascontiguousarray(vertices)
        corners = np.concatenate([vertices, self.vertices])
        axes = np.linspace(corners.min(axis=0), corners.max(axis=0), 64).T
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        mine, true = (
            igl.fast_winding_number(v, f, nodes) > 0.5 for v, f in ((vertices, faces), (self.vertices, self.faces))
        )
        away = np.sqrt(igl.point_mesh_squared_distance(self.hidden, vertices, faces)[0])
        covered = ""
        if radii is not None:
            covered = f"{(away <= radii[cKDTree(vertices).query(self.hidden)[1]]).mean():.1%}, {np.median(radii):.1f}"
        volume = trimesh.Trimesh(vertices, faces, process=False).volume / self.volume - 1
        iou = (mine & true).sum() / (mine | true).sum()
        median = np.median(away)
        most = np.percentile(away, 95)
        return f"{iou:.3f} | {median:5.2f} / {most:5.2f} | {covered} | {100 * volume:+.1f}"


def load(folder: Path, name: str) -> trimesh.Trimesh:
    return trimesh.load_mesh(folder / f"{name}.stl")


def measured(folder: Path, which: str) -> Points:
    """2,500 points of an input, and their normals."""
    part = load(folder, INPUTS[which])
    points, normals = np.asarray(part.vertices), np.asarray(part.vertex_normals)
    chosen = np.random.default_rng(0).permutation(len(points))[:2500]
    return points[chosen].copy(), normals[chosen]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("MEREO_ASSETS", "")) / "liver_phantom"
    parser.add_argument("folder", nargs="?", type=Path, default=default)
    folder = parser.parse_args().folder
    rest, rival = (load(folder, name) for name in ("initial-surface", "pbsm_from_endoscope"))
    vertices, faces = np.asarray(rest.vertices), np.asarray(rest.faces, dtype=np.int64)
    half = float(np.ptp(vertices, axis=0).max()) / 2
    truth = Truth(folder, rest)
    print("| input | known | method | IoU | hidden, mm | within radius, its median mm | volume, % | s |")
    print("|---|---|---|---|---|---|---|---|")
    for which, name, mesh in (("", "identity", rest), ("B", "rival's file", rival)):
        row = truth.line(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
        print(f"| {which} | | {name} | {row} | |")
    with TemporaryDirectory() as place:
        answer = Mereo(folder, rest, Path(place))
        for which, noise in NOISE.items():
            cloud = measured(folder, which)
            for name, make in (("rigid", rigid_modes), ("Gaussian process", gaussian_process)):
                start = time.perf_counter()
                moved = fit_modes(vertices, faces, make(vertices, half), cloud, noise)
                row = truth.line(moved, faces)
                spent = time.perf_counter() - start
                print(f"| {which} | pose given | {name} | {row} | {spent:.1f} |", flush=True)
            if find_spec("pycpd") is not None:
                start = time.perf_counter()
                row = truth.line(coherent_point_drift(vertices, cloud), faces)
                spent = time.perf_counter() - start
                print(f"| {which} | pose given | coherent point drift | {row} | {spent:.1f} |", flush=True)
            for known in ("search", "pose given", "underside held"):
                moved, triangles, radii, spent = answer(which, known)
                row = truth.line(moved, triangles, radii)
                print(f"| {which} | {known} | mereo | {row} | {spent:.1f} |", flush=True)


if __name__ == "__main__":
    main()
