"""Commands of the command line: one dataclass for each, its fields the options, ``run`` the work.

``run`` imports what it needs itself, so that ``mereo --help`` answers without loading torch.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from mereo.cli.config_file import ConfigFile, options_of
from mereo.cli.outcome import Outcome
from mereo.cli.place_option import PlaceOption
from mereo.cli.positionals import AssetNames, DatasetFolder, SceneName, WeightsName
from mereo.fitting.config import AnswerMethod
from mereo.geometry.conventions import WorkspaceName
from mereo.io.bounds import Count, CountOrNone, ImageSize, NotNegative, Threads, Workers
from mereo.io.config import CONFIG
from mereo.io.cores import workers_for
from mereo.models.config import EXACT, Device, InferenceConfig
from mereo.synthesis.config import GenerateConfig, Sensor, SensorConfig
from mereo.training.config import PresetName, TrainConfig
from mereo.workers.config import ONE_CPU, RayAddress, TaskResources, cluster_of


@dataclass(frozen=True)
class Demo:
    """Find an object in a real scan by its meshes; with the extra `network` also shipped frames, by network and fit.

    Attributes:
        output: folder for meshes, pictures and reports.
        json: print one JSON object on standard output, of the scores, and all else on standard error.
    """

    output: Path = Path("out/demo")
    json: bool = False

    def run(self) -> Outcome:
        """Reconstruct and print every input of the demo."""
        from mereo.cli.demo import main

        return Outcome(main(self.output))


@dataclass(frozen=True)
class Doctor:
    """Show versions, device, CPU features and extras, and how to install what is missing."""

    def run(self) -> None:
        """Print what is installed and what this machine offers."""
        from mereo.cli.doctor import diagnose

        diagnose()


@dataclass(frozen=True)
class AssetsList:
    """Name the downloadable meshes and scans, with licence and credit."""

    def run(self) -> None:
        """Print every asset with its licence, credit and place."""
        from mereo_objects.assets import ASSETS, location

        for asset in ASSETS.values():
            print(f"{asset.name}\n  {asset.description}\n  {asset.licence}; credit: {asset.credit}")
            print(f"  {location(asset.name) or 'not here yet'}")


@dataclass(frozen=True)
class AssetsGet:
    """Download assets, check them, and print where they are.

    Attributes:
        names: from `mereo assets list`; none means all of them.
    """

    names: AssetNames = ()

    def run(self) -> None:
        """Fetch assets and print where they are."""
        from mereo_objects.assets import ASSETS, get

        for name in self.names or ASSETS:
            print(get(name))


@dataclass(frozen=True)
class Generate:
    """Make labelled training examples of a scene.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        examples: how many.
        output: folder to create, or its URL in an object storage, s3://BUCKET/FOLDER or gs://BUCKET/FOLDER.
        seed: example i comes from (seed, i) alone; seeds from 1,000,000 up are for testing.
        workers: processes, each in one thread; the result does not depend on them. 0 means as many as --threads.
        shard: make only part i of n, as i/n from 0/n to (n-1)/n, for example on several machines.
        resume: go on with a run that was stopped.
        test: allow a test seed.
        sensor: whose errors the options sensor.* below start from: the paper's, or those of a kind of depth camera.
        settings: how one example is made.
        threads: processes where --workers does not say; 0 means one per core.
        ray: make them in tasks of a Ray cluster: local, one of so many workers for this run; auto or HOST:PORT, all
            of the one that this machine is a node of.
        options_from: file of options, JSON or YAML, such as the config.json of a result; the command line wins over it.
    """

    scene: SceneName
    examples: Count
    output: PlaceOption
    seed: CountOrNone = 0
    workers: Workers = 0
    shard: str = "0/1"
    resume: bool = False
    test: bool = False
    sensor: Sensor = "paper"
    settings: Annotated[GenerateConfig, arg(name="")] = field(default_factory=GenerateConfig)
    threads: Threads = 0
    ray: RayAddress = None
    options_from: ConfigFile = None

    def run(self) -> None:
        """Write the folder of labelled examples."""
        from mereo.api.generate import generate
        from mereo.io.atomic_files import json_text
        from mereo.io.places import write_whole

        generate(
            self.scene,
            self.output,
            self.settings,
            examples=self.examples,
            seed=self.seed,
            workers=workers_for(self.workers, self.threads),
            shard=part_of(self.shard),
            resume=self.resume,
            test=self.test,
            ray=self.ray,
        )
        write_whole(self.output / CONFIG, json_text(options_of(self, "generate")).encode())


@dataclass(frozen=True)
class Train:
    """Train a network on generated examples; the same command again continues a stopped run: needs the extra `network`.

    Attributes:
        dataset: folder written by `mereo generate`, or its URL in an object storage.
        output: folder of the run.
        preset: what the options below start from: as published, as published for --network.encoder autodecoder,
            recommended, the same for a GPU, one for tests.
        config: the recipe; defaults are the chosen preset's.
        device: where the network is trained; auto takes a CUDA device where there is one.
        threads: of torch and all else that computes; 0 means one per core, and 1 helps on a busy machine.
        options_from: file of options, JSON or YAML, such as the config.json of a run; the command line wins over it.
    """

    dataset: DatasetFolder
    output: Path
    preset: PresetName = "base"
    config: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    device: Device = "auto"
    threads: Threads = 0
    options_from: ConfigFile = None

    def run(self) -> None:
        """Train, and print where the weights are."""
        from mereo.api.steps import train

        print(f"weights: {train(self.dataset, self.output, self.config, device=self.device)}")


@dataclass(frozen=True)
class Evaluate:
    """Score weights on test examples of their scene: IoU, mIoU, pictures of the errors: needs the extra `network`.

    Attributes:
        weights: a shipped name or a file.
        output: folder to create.
        examples: how many.
        seed: test seeds start at 1,000,000.
        scene: the scene's name or file, where it is not the built-in one that the weights were trained on; for scans,
            where the truth files name a Python scene, which they cannot have run.
        scans: score real scans instead of rendered views: truth files, or their folders, of `mereo align`; without
            any, the four range scans of the bunny, whose poses are known.
        sensor: whose errors the options sensor.* below start from: the paper's, or those of a kind of depth camera.
        image_size: the depth image is square, in pixels; 96 is the paper's, a depth camera gives the object 200 to 400.
        noise_std: Gaussian noise on the depth, standard deviation in scene units.
        workspace: where the camera may be: own is what the scene states; cone is on one side of the object, sphere all
            around it, at any roll.
        terms: what else is wrong with the depth image.
        inference: where and how exactly the network computes.
        method: whose answer is scored: auto is what `mereo reconstruct` gives by default, with the network's, the
            modes' and the draws' own scores beside it; network the network alone; modes leaves the draws out.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
        threads: of torch and all else that computes; 0 means one per core.
        ray: score each view in a task of a Ray cluster: local, one of so many --threads for this run; auto or
            HOST:PORT, the one that this machine is a node of.
        task: what each task has for itself.
        json: print the scores as one JSON object on standard output, and all else on standard error.
        options_from: file of options, JSON or YAML, such as the config.json of a result; the command line wins over it.
    """

    weights: WeightsName
    output: Path
    examples: Count = 128
    seed: CountOrNone = 1_000_000
    scene: str | None = None
    scans: tuple[Path, ...] | None = None
    sensor: Sensor = "paper"
    image_size: ImageSize = 96
    noise_std: NotNegative = 0.1
    workspace: WorkspaceName = "own"
    terms: Annotated[SensorConfig, arg(name="sensor")] = field(default_factory=SensorConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = EXACT
    method: AnswerMethod = "auto"
    force: bool = False
    threads: Threads = 0
    ray: RayAddress = None
    task: Annotated[TaskResources, arg(name="")] = ONE_CPU
    json: bool = False
    options_from: ConfigFile = None

    def run(self) -> Outcome:
        """Write scores and pictures of their errors, and print the table."""
        from mereo.api.steps import evaluate
        from mereo.evaluation.tables import read_metrics

        settings = GenerateConfig(
            image_size=self.image_size, noise_std=self.noise_std, sensor=self.terms, workspace=self.workspace
        )
        if self.scans is not None and settings != GenerateConfig():
            raise ValueError(
                "--scans are real and take no simulated camera: leave out --sensor, --image-size, --noise-std and "
                "--workspace"
            )
        evaluate(
            self.weights,
            self.scene,
            output=self.output,
            examples=self.examples,
            seed=self.seed,
            scans=self.scans,
            settings=None if self.scans is not None else settings,
            method=self.method,
            inference=self.inference,
            ray=cluster_of(self.ray, self.threads, self.task),
            overwrite=self.force,
            options=options_of(self, "evaluate"),
        )
        return Outcome(read_metrics(self.output / "metrics.json") if self.json else {})


@dataclass(frozen=True)
class Export:
    """Write weights as two graphs, encoder and query, for ONNX Runtime (no torch needed) or for torch.export.

    Attributes:
        weights: a shipped name or a file.
        output: folder to create; for ONNX with mereo_onnx.py, which runs the graphs with numpy and onnxruntime alone.
        format: onnx, or torch for .pt2 files.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    weights: WeightsName
    output: Path
    format: Literal["onnx", "torch"] = "onnx"
    force: bool = False

    def run(self) -> None:
        """Write the folder with both graphs of a network."""
        from mereo.api.steps import export

        export(self.weights, self.output, self.format, self.force)


def part_of(shard: str) -> tuple[int, int]:
    """Part and number of parts of a shard: ``"1/4"`` is part 1 of 4, counted from 0. Raises ``ValueError``."""
    part, _, parts = shard.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and int(part) < int(parts)):
        raise ValueError(f"the shard is {shard!r}; it must be i/n with i from 0 to n - 1: give for example --shard 0/4")
    return int(part), int(parts)
