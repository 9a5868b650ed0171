"""Reconstruct every segment of an object from one depth frame, and say where each is, in the camera's frame.

    python examples/reconstruct_cloud.py [CLOUD] [OUTPUT]

Without a cloud it takes the depth frame of the bunny that comes with the package.
"""

import sys
from pathlib import Path

import mereo
from mereo.evaluation.sample_views import load_view


def main(cloud_path: str | None = None, output: str = "out/example", weights: str = "bunny") -> None:
    cloud = mereo.read_point_cloud(cloud_path) if cloud_path else load_view("bunny").depth.to_points()
    model = mereo.load_model(weights)
    result = mereo.reconstruct(cloud, model, resolution=64)
    for segment in result.segments:
        x, y, z = segment.centroid
        print(f"{segment.name:<12} at ({x:.3f}, {y:.3f}, {z:.3f})  confidence {segment.confidence:.2f}")
    mereo.write_reconstruction(result, cloud, output, force=True)
    print(f"wrote {output}; open {Path(output) / 'report.html'}")


if __name__ == "__main__":
    main(*sys.argv[1:3])
