"""The commands for one tool each: align, experiment, bench, doctor."""

import importlib.metadata
import os
import platform
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mereo.cli.options import ScanCloud
from mereo.geometry.conventions import Names
from mereo.io.bounds import Count, PositiveOrUnknown, Threads, Workers
from mereo.io.cores import workers_for
from mereo.models.config import Device, Precision
from mereo_experiments.paper.scales import ExperimentName, ScaleName
from mereo_learning.config import PresetName

if TYPE_CHECKING:
    from mereo_learning.placement import Placement


@dataclass(frozen=True)
class Align:
    """Place every segment of a model on a full-resolution scan, from a rough start: ground truth for `mereo evaluate`.

    Attributes:
        scan: point cloud (PLY, PCD, XYZ, NPY, NPZ) that shows this object alone, from one side.
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: folder to create: truth.json, overlay.png, segments.glb.
        start: JSON file with poses or picked point pairs, of the object or of single segments.
        unit: of the scan.
        scene_unit_mm: millimetres per scene unit, where the scene does not say.
        frame: axes of the scan: camera is x right, y down, z forward; scanner is y up, z toward the scanner.
        is_rigid: the object is rigid: place it as a whole.
        hold: segments to leave at their start or at their neighbour, whatever the scan shows.
        drop_invalid: leave out NaN, infinite and all-zero points instead of refusing the file.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    scan: ScanCloud
    scene: str
    output: Path
    start: Path
    unit: Literal["m", "cm", "mm", "in"] = "m"
    scene_unit_mm: PositiveOrUnknown = None
    frame: Literal["camera", "scanner"] = "camera"
    is_rigid: Annotated[bool, arg(name="rigid")] = False
    hold: Names = ()
    drop_invalid: bool = False
    force: bool = False

    def run(self) -> None:
        """Write truth.json, overlay.png and segments.glb into a new folder, and print the residuals."""
        from mereo.geometry.conventions import UNITS_M
        from mereo.io.atomic_files import new_directory
        from mereo.io.readers import read_point_cloud
        from mereo.io.writers.glb import viewer_rotation, write_segments_glb
        from mereo.scenes.registry import files_of, is_yaml, load_scene
        from mereo.scenes.scene import SCENES
        from mereo.visualization.contact_sheets import save_png
        from mereo_learning.error_maps import overlay
        from mereo_learning.icp import load_icp
        from mereo_learning.placement import place, read_start
        from mereo_learning.scans import TRUTH, ScanFile, write_truth

        load_icp()  # its absence is better said before the work
        scan = ScanFile(self.scan, self.unit, self.frame, self.drop_invalid)
        with new_directory(self.output, self.force, [self.scan, *files_of(self.scene), self.start]) as directory:
            scene = load_scene(self.scene)
            rest = scene.rest
            unit_m = scene.unit_m if self.scene_unit_mm is None else self.scene_unit_mm / 1000
            cloud = read_point_cloud(self.scan, self.drop_invalid)
            scale = None if unit_m is None else unit_m / UNITS_M[self.unit]
            start = read_start(self.start, rest, scale)
            placement = place(rest, cloud.points, start, self.frame, is_rigid=self.is_rigid, hold=self.hold)
            write_truth(directory, self.output, scan, self.scene, rest, placement, start.how)
            write_segments_glb(
                directory / "segments.glb", placement.mesh, viewer_rotation(self.frame), UNITS_M[self.unit]
            )
            save_png(directory / "overlay.png", overlay(placement.mesh, placement.limit, cloud, scan))
        print_placement(placement, f"{self.scan.name}, {len(cloud)} points", 1000 * UNITS_M[self.unit])
        # a data file runs no Python scene
        trusted = "" if self.scene in SCENES or is_yaml(self.scene) else f" --scene {self.scene}"
        evaluation = f"mereo evaluate WEIGHTS --scans {self.output / TRUTH}{trusted}"
        print(f"wrote {self.output}; look at {self.output / 'overlay.png'}, then: {evaluation}")


def print_placement(placement: "Placement", title: str, mm: float) -> None:
    """Print a table of the segments, lengths in millimetres, and how much of the scan they explain.

    Args:
        placement: in the scan's frame and unit.
        title: of the table.
        mm: millimetres in a unit of the scan.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{title}; millimetres and degrees", title_justify="left", box=None, padding=(0, 2, 0, 0))
    for column in ("segment", "placed by"):
        table.add_column(column, no_wrap=True)
    for column in ("points", "median", "RMS", "95 %", "moved", "turned", "held"):
        table.add_column(column, justify="right")
    for segment in placement.segments:
        residuals = (segment.median, segment.rms, segment.p95)
        fit = [f"{mm * value:.3f}" if segment.points else "-" for value in residuals]
        by = segment.placed_by if segment.seen else f"unseen: {segment.placed_by}"
        motion = f"{mm * segment.shift:.2f}", f"{segment.turn_deg:.1f}"
        table.add_row(segment.name, by, str(segment.points), *fit, *motion, str(segment.held or ""))
    Console(markup=False, emoji=False).print(table)
    print(f"{placement.explained:.1%} of the scan lies within {mm * placement.limit:.3g} mm of the placed segments")
    for segment in placement.segments:
        if segment.held:
            print(
                f"{segment.name}: the scan leaves {segment.held} of 6 directions open (it could turn or slide); there "
                "it stays where it was placed together with the others"
            )


@dataclass(frozen=True)
class Experiment:
    """Repeat one of the paper's experiments; the same command again continues a stopped one. `list` says which.

    Attributes:
        name: which one; list shows what each answers and costs, and which results are here.
        scale: smoke shows in minutes that it runs, cpu takes hours on two cores, paper is the full recipe for a GPU.
        objects: some of the experiment's own, whatever the scale takes: --objects engine.
        output: folder for datasets, runs, scores and results, shared by all experiments.
        workers: processes that make datasets; 0 means as many as --threads.
        threads: of torch and all else that computes; 0 means one per core, and 1 helps on a busy machine.
    """

    name: Positional[Literal["list", ExperimentName]]
    scale: ScaleName = "smoke"
    objects: Names = ()
    output: Path = Path("out/experiments")
    workers: Workers = 0
    threads: Threads = 0

    def run(self) -> None:
        """Run the experiment and print its table, or list all."""
        if self.name == "list":
            from mereo_experiments.paper.registry import list_experiments

            list_experiments(self.output)
            return
        from mereo.io.extras import pyplot

        pyplot()  # before the hours that it takes
        from mereo_experiments.paper.registry import run_experiment

        workers = workers_for(self.workers, self.threads)
        directory = run_experiment(self.name, self.scale, self.output, workers, self.objects)
        print((directory / "table.md").read_text("utf-8"))
        print(f"wrote {directory}")


@dataclass(frozen=True)
class BenchCommand:
    """Time every stage of an answer against this machine's floor, and against the straightforward implementation.

    Attributes:
        weights: a shipped name or a file; without it the preset's network is fitted to one shipped frame first.
        preset: the architecture to fit.
        device: where the network runs, auto on a CUDA device where there is one; preprocessing is always on the CPU.
        precision: of the network's products; auto takes bfloat16 on CUDA and on CPUs that are much faster in it.
        repeats: of each stage.
        rival: time the straightforward implementation too (minutes on a CPU), and say what share of labels differ.
        threads: of torch and all else that computes; 0 means one per core.
        output: a JSON file for the figures.
        force: replace an existing file, unless the weights are read from it.
    """

    weights: str | None = None
    preset: PresetName = "paper"
    device: Device = "auto"
    precision: Precision = "float32"
    repeats: Count = 7
    rival: bool = False
    threads: Threads = 0
    output: Path | None = None
    force: bool = False

    def run(self) -> None:
        """Print the times of all stages of an answer."""
        from mereo.io.atomic_files import check_file_place
        from mereo.models.device import find_device
        from mereo_experiments.speed.report import benchmark

        if self.output is not None:
            check_file_place(self.output, force=self.force, inputs=[self.weights] if self.weights else [])
        device = find_device(self.device)
        measured = benchmark(self.weights, self.preset, device, self.precision, self.repeats, self.rival)
        measured.print()
        if self.output is not None:
            measured.write(self.output, self.force)
            print(f"wrote {self.output}")


# --- doctor -----------------------------------------------------------------------------------------------------------

PURPOSES: dict[str, str] = {
    "network": "weights: training them, and fits that start from them",
    "view": "the pages of `mereo view`",
    "track": "training curves in TensorBoard",
    "plots": "curves of training runs, charts of experiments",
    "onnx": "networks for other runtimes",
    "cad": "3MF files",
    "medical": "NIfTI and NRRD volumes",
    "robot": "robots of URDF and SDF files",
    "sensors": "ROS bags, EXR depth images and Zivid clouds",
    "realsense": "cameras of this kind, in `mereo stream realsense`",
    "simulation": "states from finite elements, in VTK's formats too",
    "storage": "datasets in S3 and what speaks it",
    "gcs": "datasets in Google Cloud Storage",
    "cluster": "generation, scoring, frames and learning on Ray clusters",
    "align": "ground truth from scans",
    "serve": "answers over HTTP",
    "docs": "the documentation as pages",
    "dev": "tests and checks",
}
"""Purpose of each extra of pyproject.toml; which packages it means is read from the installed metadata."""


@dataclass(frozen=True)
class Doctor:
    """Show versions, device, threads and extras, and how to install what is missing."""

    def run(self) -> None:
        """Print what is installed and what this machine offers, one fact a line."""
        facts = {
            "mereo": _version("mereo") or "not installed",
            "python": f"{platform.python_version()} ({sys.executable})",
            "system": f"{platform.system()} {platform.machine()}",
        }
        for requirement in requirements(""):
            facts[_name(requirement)] = _version(_name(requirement)) or f"missing: {_install([requirement])}"
        try:
            import torch
        except ModuleNotFoundError:
            facts["device"] = "cpu; objects are found by search, as the extra `network` is not installed"
        else:
            device = (
                f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}" if torch.cuda.is_available() else "cpu"
            )
            facts |= {"torch": torch.__version__, "device": device}
            facts["threads"] = f"{torch.get_num_threads()} of {os.cpu_count()} cores"
        for extra, purpose in PURPOSES.items():
            missing = [each for each in requirements(extra) if _version(_name(each)) is None]
            facts[extra] = f"missing, for {purpose}: {_install(missing)}" if missing else f"installed, for {purpose}"
        for name, fact in facts.items():
            print(f"{name:<14} {fact}")


def requirements(extra: str) -> list[str]:
    """Requirements that pyproject.toml declares for an extra, such as ``tensorboard>=2.18``; ``""`` is mereo itself."""
    try:
        declared = importlib.metadata.requires("mereo") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    entries = [entry.partition(";") for entry in declared]
    extras = [re.search(r"extra == ['\"](.+?)['\"]", marker) for _, _, marker in entries]
    return [
        entry[0].strip() for entry, named in zip(entries, extras, strict=True) if (named[1] if named else "") == extra
    ]


def _install(missing: list[str]) -> str:
    return shlex.join([sys.executable, "-m", "pip", "install", *missing])


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement)[0]


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
