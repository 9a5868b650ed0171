"""``mereo reconstruct``: one frame of a sensor to a folder of results."""

import warnings
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mereo.io.atomic_files import new_directory
from mereo.io.config import DEFAULT_FILES, FilesConfig, InputConfig
from mereo.io.writers.formats import chosen_formats
from mereo.models.config import InferenceConfig
from mereo.models.weights import load_for
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import STRAY_SHARE, stray_share
from mereo.reconstruction.observation import SizeWarning, read_observation, size_warning
from mereo.reconstruction.pipeline import Reconstruction, reconstruct
from mereo.visualization.result_files import write_files


def reconstruct_file(
    input: str | Path,
    weights: str | Path,
    output: str | Path,
    *,
    resolution: int = 128,
    reading: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008
    inference: InferenceConfig = InferenceConfig(),  # noqa: B008
    files: FilesConfig = DEFAULT_FILES,
    force: bool = False,
) -> Reconstruction:
    """``mereo reconstruct``: read one frame of a sensor, reconstruct, write a new directory, print what was found."""
    formats = chosen_formats(files.formats)  # a missing extra is said before the work, not after
    with new_directory(output, force) as directory:
        seen = read_observation(input, reading, isolation)
        print(seen)
        apart = 0.0 if isolation.largest_cluster else stray_share(seen.cloud)
        if apart > STRAY_SHARE:
            print(f"{apart:.1%} of it lies apart from the largest group; if that is not the object: --largest-cluster")
        model = load_for(weights, inference)
        warning = size_warning(seen, model.provenance)
        if warning is not None:
            warnings.warn(warning, SizeWarning, stacklevel=2)
        result = reconstruct(seen.cloud, model, resolution, seen.frame, label_points="points" in formats)
        facts = {"title": seen.source, "weights": str(weights), "resolution": resolution, "points": len(seen.cloud)}
        facts |= {"device": model.device.type, "precision": model.working_precision}
        write_files(directory, result, seen.cloud, seen.frame, files, seen.unit_m, {**facts, **seen.facts()})
    print_segments(result, f"{seen.source}, {len(seen.cloud)} points")
    print(f"wrote {output} in {sum(result.timings_s.values()):.1f} s; open {Path(output) / 'report.html'} in a browser")
    return result


def print_segments(result: Reconstruction, title: str) -> None:
    """A table of the segments, and a line of the stages' seconds."""
    table = Table(title=title, title_justify="left")
    table.add_column("segment")
    for column in ("volume", "confidence", "components", "centroid"):
        table.add_column(column, justify="right")
    for found in result.segments:
        place = " ".join(f"{value:.4g}" for value in found.centroid)
        row = (f"{found.volume:.4g}", f"{found.confidence:.2f}", str(found.components), place)
        table.add_row(found.name, *(row if found.voxels else ("0", "not found", "0", "")))
    console = Console()
    console.print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in result.timings_s.items())
    console.print(f"seconds: {stages}", highlight=False, soft_wrap=True)
    if result.clipped:
        console.print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")
