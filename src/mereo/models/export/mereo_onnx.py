"""Runner of a network that `mereo export` has written, with numpy and onnxruntime alone: no torch, no mereo.

    python mereo_onnx.py frame.npy --points queries.npy -o out.npz

    from mereo_onnx import Runner
    runner = Runner("folder with encoder.onnx, query.onnx and model.json")
    labels, distances, directions = runner(cloud, queries)

Clouds and queries are [n, 3], in the camera's frame (x right, y down, z forward, camera at the origin), in any unit.
Written for Python 3.8 and later, because robots' computers are slow to change.
"""

import argparse
import io
import json
import sys
from pathlib import Path

import numpy as np

QUERY_CHUNK = 16384
"""Queries evaluated at once: memory, not accuracy."""


class Runner:
    """Network with its segments: ``names[k]`` and ``colors[k]`` belong to label k + 1; label 0 is empty space."""

    def __init__(self, folder: str = str(Path(__file__).parent), providers: tuple = ("CPUExecutionProvider",)) -> None:
        import onnxruntime

        self.settings = json.loads(Path(folder, "model.json").read_text(encoding="utf-8"))
        self.names, self.colors = self.settings["names"], self.settings["colors"]
        self._encoder, self._query = (
            onnxruntime.InferenceSession(str(Path(folder, name)), providers=list(providers))
            for name in ("encoder.onnx", "query.onnx")
        )

    def __call__(self, cloud: np.ndarray, queries: np.ndarray) -> tuple:
        """Labels [q], signed distances [q] (negative inside) and unit directions [q, 3] to the nearest surface.

        Distances are in the cloud's unit. What the network was not trained on is NaN.
        """
        return self.query(self.encode(cloud), queries)

    def encode(self, cloud: np.ndarray) -> tuple:
        """Code of a cloud, all that queries need to know of it; compute it once."""
        seen, center, scale = prepare(cloud, self.settings)
        given = {"cloud": seen[None], "viewpoint": (-center * scale)[None].astype(np.float32)}
        names = [output.name for output in self._encoder.get_outputs()]
        code = dict(zip(names, self._encoder.run(names, {"cloud": given["cloud"]})))
        return {**code, **given}, center, scale

    def query(self, code: tuple, queries: np.ndarray) -> tuple:
        """Answers at points for an encoded cloud, as ``__call__`` gives them."""
        tensors, center, scale = code
        wanted = [entry.name for entry in self._query.get_inputs() if entry.name != "points"]
        given = {name: tensors[name] for name in wanted}
        points = ((np.asarray(queries, dtype=np.float64) - center) * scale).astype(np.float32)
        parts = []
        for start in range(0, max(len(points), 1), QUERY_CHUNK):
            chunk = points[None, start : start + QUERY_CHUNK]
            parts.append(self._query.run(["logits", "distance", "direction"], {"points": chunk, **given}))
        logits, distance, direction = (np.concatenate(part, axis=1)[0] for part in zip(*parts))
        return logits.argmax(axis=1).astype(np.uint8), distance / np.float32(scale), direction


def prepare(cloud: np.ndarray, settings: dict) -> tuple:
    """Points that the network sees, normalized and in farthest-point order, with center and scale."""
    points = np.asarray(cloud, dtype=np.float64)
    fewest, limit = settings["fewest_points_of_a_cloud"], settings["points"]
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"the cloud has shape {points.shape}; it must be [n, 3] of finite numbers: check the file")
    if len(points) < fewest:
        raise ValueError(f"the cloud has {len(points)} points; the encoder needs at least {fewest}: move closer")
    if (points[:, 2] <= 0).any():
        raise ValueError("points have z <= 0, behind the camera; the cloud must be x right, y down, z forward: turn it")
    low = points.min(axis=0)
    high = points.max(axis=0)
    half = float((high - low).max()) / 2
    if not half > 0:
        raise ValueError("all points coincide; the cloud needs an extent: check the file's columns and units")
    center, scale = (low + high) / 2, 1.0 / half
    if len(points) > limit * settings["dense_factor"]:
        # ordering is quadratic: dense clouds are thinned first, always in the same way
        points = points[np.random.default_rng(0).choice(len(points), limit * settings["dense_factor"], replace=False)]
    normalized = ((points - center) * scale).astype(np.float32)
    seen = normalized[farthest_point_order(normalized, limit)]
    return seen[np.arange(limit) % len(seen)], center, scale  # too few points are repeated


def farthest_point_order(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of ``points``, each the farthest from all before it; ties go to the smaller x, then y, then z."""
    rank = np.lexsort(points.T[::-1])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    xyz = np.ascontiguousarray((points[rank] - middle).T, dtype=np.float32)
    order = np.empty(min(count, len(points)), dtype=np.int64)
    distance = np.full(len(points), np.inf, dtype=np.float32)
    current = int(np.add.reduce(xyz * xyz, axis=0).argmax())
    for i in range(len(order)):
        order[i] = current
        difference = xyz - xyz[:, current : current + 1]
        np.minimum(distance, np.add.reduce(difference * difference, axis=0), out=distance)
        distance[current] = -1.0  # below any distance: a point is taken once
        current = int(distance.argmax())
    return rank[order]


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description="Ask an exported mereo network about points.")
    parser.add_argument("cloud", help=".npy, [n, 3], camera frame")
    parser.add_argument("--points", required=True, help=".npy, [q, 3], same frame and unit")
    parser.add_argument("-o", "--output", required=True, help=".npz: labels, distances, directions, names")
    parser.add_argument("--model", default=str(Path(__file__).parent), help="folder of the graphs; default: this one")
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    options = parser.parse_args()
    try:
        if Path(options.output).exists() and not options.force:
            raise ValueError(f"{options.output} exists; it is not overwritten: choose another --output or pass --force")
        runner = Runner(options.model)
        answers = runner(np.load(options.cloud), np.load(options.points))
        content = io.BytesIO()
        named = dict(zip(("labels", "distances", "directions"), answers))
        np.savez_compressed(content, names=np.array(runner.names), **named)
        Path(options.output).write_bytes(content.getvalue())
    except (ValueError, OSError, ImportError) as error:
        print(f"mereo_onnx: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
