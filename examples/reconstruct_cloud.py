"""Reconstruct every segment of an object from one depth frame, and say where each is, in the camera's frame.

    python examples/reconstruct_cloud.py [CLOUD] [OUTPUT]

Without a cloud it takes the depth frame of the bunny that comes with the package.
"""

import sys
from pathlib import Path

import mereo
from mereo.io.atomic_files import check_new_directory


def main(
    cloud_path: str | None = None, output: str = "out/example", weights: str = "bunny", *, force: bool = False
) -> None:
    try:
        check_new_directory(Path(output), force, [] if cloud_path is None else [cloud_path])
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {error}") from None
    result = mereo.reconstruct(cloud_path or "bunny", mereo.load_object(weights), resolution=64)
    for segment in result:
        x, y, z = segment.centroid
        print(f"{segment.name:<12} at ({x:.3f}, {y:.3f}, {z:.3f})  confidence {segment.confidence:.2f}")
    result.save(output, overwrite=force)
    print(f"wrote {output}; open {Path(output) / 'report.html'}")


if __name__ == "__main__":
    main(*[word for word in sys.argv[1:] if word != "--force"][:2], force="--force" in sys.argv)
