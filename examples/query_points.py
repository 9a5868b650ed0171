"""Ask the model about single points, as a robot would: which segment is here, how far is the surface, which way?

    python examples/query_points.py

The code of a frame is computed once; queries then take microseconds each.
"""

import time

import numpy as np

import mereo
from mereo.synthesis.sample_views import load_view


def main(weights: str = "bunny", queries: int = 2000) -> None:
    cloud = load_view("bunny").depth.to_points()  # points [n, 3]: x right, y down, z forward
    model = mereo.load_model(weights)
    code = model.encode(cloud)

    # a tool moves along the optical axis through the middle of what the camera sees
    tip = np.median(cloud.points, axis=0)
    path = tip + np.linspace(-5.0, 25.0, 7)[:, None] * np.array([0.0, 0.0, 1.0])
    answer = model.query(code, path)
    for point, label, distance in zip(path, answer.label, answer.distance, strict=True):
        name = "empty space" if label == 0 else model.names[label - 1]
        print(f"z = {point[2]:7.2f}: {name:<12} {abs(distance):5.2f} to the nearest surface")

    many = np.random.default_rng(0).uniform(cloud.points.min(axis=0), cloud.points.max(axis=0), size=(queries, 3))
    start = time.perf_counter()
    model.query(code, many)
    print(f"{queries} points in {1e3 * (time.perf_counter() - start):.0f} ms")


if __name__ == "__main__":
    main()
