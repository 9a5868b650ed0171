"""The command ``mereo demo``: a real scan by its object's meshes alone, and frames by shipped weights."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from mereo.cli.options import Outcome
from mereo.io.atomic_files import JsonObject

if TYPE_CHECKING:
    from mereo.api.objects import Object
    from mereo.api.result import Result
    from mereo.geometry.metrics import TruthGrid
    from mereo.io.sensor_frame import SensorFrame

RESOLUTION = 100

FRAME, MESHES = Path("frames/bun000.ply"), Path("bunny-meshes")
"""The scan as a depth camera's frame, and the folder of its object's meshes: with these a user goes on."""

NEXT = """
The same by hand, from the scan and the meshes that are used here
  mereo reconstruct {frame} --object {meshes} --output result

On your own object, from its meshes: nothing is trained; docs/own-object.md has joints
  mereo reconstruct cloud.ply --object PART.stl PART.stl --output result
  mereo reconstruct depth.png --intrinsics camera.json --depth-scale 1000 --object PART.stl PART.stl --output result

At once, and telling look-alike parts apart: with a network, where that helps, ten minutes for an object
  mereo learn PART.stl PART.stl --output learned --minutes 10
  mereo reconstruct frame.ply --object learned --output result

In another shell, first: source .venv/bin/activate"""


@dataclass(frozen=True)
class Demo:
    """Find an object in a real scan by its meshes; with the extra `network` also shipped frames, by network and fit.

    Attributes:
        output: folder for the frame and the meshes of the first input, pictures and reports.
        json: print one JSON object on standard output, of the scores, and all else on standard error.
    """

    output: Path = Path("out/demo")
    json: bool = False

    def run(self) -> Outcome:
        """Reconstruct every input, and print its scores, seconds and where to look."""
        from mereo.api.reconstruct import reconstruct
        from mereo.io.atomic_files import check_new_directory, check_place
        from mereo.io.progress import shown_stages
        from mereo.models.weights_place import has_network

        check_place(self.output, may_be_link=True)
        scores = JsonObject()
        began = perf_counter()
        for name, title, known, frame, truth in _inputs(self.output):
            folder = self.output / name
            started = perf_counter()
            check_new_directory(folder, force=True)
            with shown_stages():
                result = reconstruct(frame, known, resolution=RESOLUTION)
                seconds = perf_counter() - started
                result.save(folder, overwrite=True)
            scores[name] = {"output": str(folder), **_print_scores(title, result, truth), "seconds": seconds}
            page = f", or in the browser: mereo view {folder}" if result.pose is not None else ""
            print(f"{len(frame.cloud)} points, {seconds:.1f} s; look at {folder / 'report.html'}{page}\n")
        if not has_network():
            print(
                "The extra `network` is not installed, so nothing is shown of networks, which start the fit at once:\n"
                "run pip install 'mereo[network]' and this again.\n"
            )
        print(f"All in {perf_counter() - began:.0f} s.")
        print(NEXT.format(frame=self.output / FRAME, meshes=self.output / MESHES))
        return Outcome(scores)


def _inputs(output: Path) -> "Iterator[tuple[str, str, Object, SensorFrame, TruthGrid]]":
    """Name, title, object, frame and truth of each input; the first one's frame and meshes are written."""
    from numpy.linalg import inv

    from mereo.api.objects import load_object
    from mereo.api.reconstruct import load_frame
    from mereo.geometry.camera import into_camera
    from mereo.geometry.mesh import SegmentedMesh
    from mereo.geometry.metrics import truth_grid
    from mereo.geometry.transforms import transform_points
    from mereo.io.atomic_files import new_directory
    from mereo.io.writers.meshes import write_positions_ply, write_surface_stl
    from mereo.models.weights_place import has_network, statistical_model_in
    from mereo.synthesis.sample_views import SHIPPED_SCAN, load_view
    from mereo_learning.scans import BUNNY_SCAN_POSES

    model = statistical_model_in("bunny")
    assert model.source_frame is not None
    rest = model.rest.transformed(inv(model.source_frame.T_scene_source))  # as in its files, metres
    frame = load_frame(SHIPPED_SCAN)
    truth = truth_grid(rest.transformed(inv(BUNNY_SCAN_POSES[SHIPPED_SCAN])))
    with new_directory(output / FRAME.parent, force=True) as folder:
        points = frame.cloud.points
        seen = transform_points(into_camera(points, frame.axes), points)
        write_positions_ply(folder / FRAME.name, seen, f"{SHIPPED_SCAN}: metres, x right, y down, z forward")
    with new_directory(output / MESHES, force=True) as folder:
        for part in rest.segments:
            write_surface_stl(folder / f"{part.name}.stl", SegmentedMesh((part,)))
    meshes = [output / MESHES / f"{part.name}.stl" for part in rest.segments]
    title = f"{SHIPPED_SCAN}: a real range scan of the Stanford bunny, by its meshes alone, nothing trained"
    yield f"{SHIPPED_SCAN}-meshes", title, load_object(meshes, units="m"), frame, truth
    if has_network():
        yield SHIPPED_SCAN, f"{SHIPPED_SCAN}: the same scan, with weights", load_object("bunny"), frame, truth
        for name in ("liver", "rope"):
            view = load_view(name)
            title = f"{name}: a rendered depth image with noise, with weights"
            yield name, title, load_object(name), load_frame(name), view.truth.scaled(view.metres)


def _print_scores(title: str, result: "Result", truth: "TruthGrid") -> dict[str, float | None]:
    """Print IoU and volume of each segment, and return IoU and mIoU."""
    from mereo.cli.reconstruct import print_source
    from mereo.geometry.metrics import grid_confusion, intersection_over_union, labels_on
    from mereo.visualization.units import Unit

    confusion = grid_confusion(truth, labels_on(result.surfaces, truth.grid), len(result.names))
    scores = intersection_over_union(confusion)
    unit = Unit(result.unit_m)
    print(title)
    for segment, iou in zip(result, scores.per_segment, strict=True):
        volume = f"{unit.volume(segment.volume)} {unit.volume_name}"
        print(f"  {segment.name:<12} IoU with the truth {iou:.3f}, volume {volume}")
    print(f"  all as one (IoU) {scores.iou:.3f}, mean of segments (mIoU) {scores.miou:.3f}")
    print_source(result)
    return {"iou": scores.iou, "miou": scores.miou}
