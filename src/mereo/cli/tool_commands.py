"""The commands for one tool each: ``align``, ``stream``, ``bench``, ``experiment``, ``release``.

See ``mereo.cli.commands`` for how commands are written.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mereo.cli.object_option import MeshUnits
from mereo.cli.positionals import InputName, ScanCloud, WeightsName
from mereo.fitting.tracking.config import StreamMethod
from mereo.io.bounds import Cells, Count, CountOrNone, Positive, PositiveOrUnknown, Threads, Workers
from mereo.io.config import InputConfig
from mereo.io.cores import workers_for
from mereo.models.config import Device, InferenceConfig, Precision
from mereo.reconstruction.config import IsolationConfig
from mereo.training.config import PresetName
from mereo_experiments.paper.scales import ExperimentName, ScaleName


@dataclass(frozen=True)
class Align:
    """Place every segment of a model on a full-resolution scan, from a rough start: ground truth for `mereo evaluate`.

    Attributes:
        scan: point cloud (PLY, PCD, XYZ, NPY, NPZ) that shows this object alone, from one side.
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: folder to create: truth.json, overlay.png, segments.glb.
        start: JSON file with poses or picked point pairs, of the object or of single segments.
        weights: instead of --start, a shipped name or a file: the network's guess. The truth is then not independent.
        unit: of the scan.
        scene_unit_mm: millimetres per scene unit, where the scene does not say.
        frame: axes of the scan: camera is x right, y down, z forward; scanner is y up, z toward the scanner.
        as_one: the object is rigid: place it as a whole.
        hold: segments to leave at their start or at their neighbour, whatever the scan shows.
        drop_invalid: leave out NaN, infinite and all-zero points instead of refusing the file.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    scan: ScanCloud
    scene: str
    output: Path
    start: Path | None = None
    weights: str | None = None
    unit: Literal["m", "cm", "mm", "in"] = "m"
    scene_unit_mm: PositiveOrUnknown = None
    frame: Literal["camera", "scanner"] = "camera"
    as_one: bool = False
    hold: tuple[str, ...] = ()
    drop_invalid: bool = False
    force: bool = False

    def run(self) -> None:
        """Write the folder of the truth and print the residuals."""
        from mereo.cli.align import align_file
        from mereo.evaluation.registration.truth_file import ScanFile

        align_file(
            ScanFile(self.scan, self.unit, self.frame, self.drop_invalid),
            self.scene,
            self.output,
            start=self.start,
            weights=self.weights,
            scene_unit_mm=self.scene_unit_mm,
            as_one=self.as_one,
            hold=self.hold,
            force=self.force,
        )


@dataclass(frozen=True)
class StreamCommand:
    """Reconstruct frames as they come: the latest one wins, a bad one is reported and passed over.

    Each answer is one line of JSON on standard output, in the input's frame and units; rate and latency come at the
    end, on standard error. Where the object's own deformation model is known, it is followed: each frame's fit starts
    from the last one's state, and network or search are asked at first and where the object is lost. The exit status is
    0 where any frame was answered and the sequence was whole, else 2.

    Attributes:
        input: a folder of depth images or point clouds, a ROS recording, or - for file names on standard input.
        object: what is looked for, as for `mereo reconstruct`: its meshes or its scene.
        weights: a shipped name or a file; with --object they start the fit, without they say what is looked for.
        units: of the object's meshes; guessed where not given.
        resolution: grid cells along the longest side of the network's surfaces: fewer are faster.
        method: auto follows the registered model where it explains the frame, if the weights carry one, and else asks
            the network; network asks it alone, for each frame anew; search leaves it out; modes takes the model in any
            case.
        uncertainty: say how sure the registered model is: radii, in the input's unit, that hold the true places of the
            surface and of each segment's centroid with probability 0.95, and intervals of its volume; takes some 30 ms.
        rate: frames per second at which a folder was recorded.
        every_frame: answer all frames, however long it takes, instead of the latest.
        watch: the folder is still filled: answer its files as they arrive or are written again, until Ctrl-C.
        surfaces: folder for the surfaces of each answered frame, one GLB file each; one with content is refused.
        rerun: a new recording FILE.rrd for `rerun FILE.rrd`, or the address of an open viewer: needs the extra `rerun`.
        force: write into a folder with content, and replace the files of the same names in it; replace a recording.
        reading: how a frame is read.
        isolation: what is left out of it.
        inference: where and how exactly the network computes.
        threads: of torch and all else that computes; 0 means one per core.
    """

    input: InputName
    object: tuple[str, ...] = ()
    weights: str | None = None
    units: MeshUnits = None
    resolution: Cells = 48
    method: StreamMethod = "auto"
    uncertainty: bool = False
    rate: Positive = 30.0
    every_frame: bool = False
    watch: bool = False
    surfaces: Path | None = None
    rerun: str | None = None
    force: bool = False
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)
    threads: Threads = 0

    def run(self) -> None:
        """Print a line of JSON for each frame, and the summary at the end."""
        # read when torch is loaded; clouds of ever other sizes would fill it with products that do not come again
        os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "4")
        from mereo.cli.stream import stream_reconstructions

        stream_reconstructions(
            self.input,
            self.weights,
            looked_for=self.object,
            units=self.units,
            resolution=self.resolution,
            rate_hz=self.rate,
            every_frame=self.every_frame,
            watch=self.watch,
            surfaces=self.surfaces,
            rerun=self.rerun,
            force=self.force,
            reading=self.reading,
            isolation=self.isolation,
            inference=self.inference,
            method=self.method,
            uncertainty=self.uncertainty,
        )


@dataclass(frozen=True)
class BenchCommand:
    """Time every stage of an answer against this machine's floor, and against the straightforward implementation.

    Attributes:
        weights: a shipped name or a file; without it the preset's network is fitted to one shipped frame first.
        preset: the architecture to fit.
        device: where the network runs, auto on a CUDA device where there is one; preprocessing is always on the CPU.
        precision: of the network's products; auto takes bfloat16 on CUDA and on CPUs that are much faster in it.
        repeats: of each stage.
        rival: time the straightforward implementation too (minutes on a CPU), and check that it gives the same labels.
        beside: processes that never rest, beside which 40,000 queries are timed again on a CPU; 0 leaves that out.
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
    beside: CountOrNone = 1
    threads: Threads = 0
    output: Path | None = None
    force: bool = False

    def run(self) -> None:
        """Print the times of all stages of an answer."""
        from mereo.models.device import find_device
        from mereo_experiments.speed.report import benchmark

        device = find_device(self.device)
        benchmark(
            self.weights,
            self.preset,
            device,
            self.precision,
            self.repeats,
            self.rival,
            self.beside,
            self.output,
            self.force,
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
    objects: tuple[str, ...] = ()
    output: Path = Path("out/experiments")
    workers: Workers = 0
    threads: Threads = 0

    def run(self) -> None:
        """Run the experiment and print its table, or list all."""
        if self.name == "list":
            from mereo.cli.experiment_list import list_experiments

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
class Release:
    """Write weights to hand on: in float16, with a model card of what they know, how they were trained and tested.

    Attributes:
        weights: a shipped name or a file.
        name: of the files: lower case letters, digits, - and _.
        output: folder to create.
        tests: folders that `mereo evaluate` has written for these weights; their scores go into the card.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    weights: WeightsName
    name: str
    output: Path
    tests: tuple[Path, ...] = ()
    force: bool = False

    def run(self) -> None:
        """Write the weights to hand on, and their model card."""
        from mereo.training.model_card import release

        release(self.weights, self.name, self.output, self.tests, self.force)
