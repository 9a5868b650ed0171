"""The commands that make and use networks: generate, dataset ..., train, evaluate, learn, export."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from mereo.cli.options import (
    ConfigFile,
    DatasetFolder,
    ObjectFiles,
    Outcome,
    Paths,
    PlaceOption,
    SceneName,
    WeightsName,
    flat_options,
    options_of,
)
from mereo.fitting.config import AnswerMethod
from mereo.geometry.conventions import LengthUnit, Pair, WorkspaceName
from mereo.io.bounds import GROUP, Count, CountOrNone, ImageSize, NotNegative, Positive, Threads, Workers
from mereo.io.config import CONFIG
from mereo.io.cores import workers_for
from mereo.models.config import EXACT, Device, ExportFormat, InferenceConfig
from mereo.synthesis.config import GenerateConfig, Sensor, SensorConfig
from mereo.workers.spread import DEFAULT_TASK, RayAddress, TaskResources, choose_cluster
from mereo_learning.config import PresetName, TrainConfig


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
    settings: Annotated[GenerateConfig, GROUP] = field(default_factory=GenerateConfig)
    threads: Threads = 0
    ray: RayAddress = None
    options_from: ConfigFile = None

    def run(self) -> None:
        """Write the folder of labelled examples."""
        from mereo.api.generate import generate
        from mereo.io.atomic_files import json_text
        from mereo.io.object_storage import write_whole

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


def part_of(shard: str) -> Pair:
    """Part and number of parts of a shard: ``"1/4"`` is part 1 of 4, counted from 0. Raises ``ValueError``."""
    part, _, parts = shard.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and int(part) < int(parts)):
        raise ValueError(f"the shard is {shard!r}; it must be i/n with i from 0 to n - 1: give for example --shard 0/4")
    return int(part), int(parts)


@dataclass(frozen=True)
class DatasetCheck:
    """Read all of a dataset, and name every file that is missing or wrong, with the reason.

    Attributes:
        dataset: folder written by `mereo generate`, or its URL in an object storage.
    """

    dataset: DatasetFolder

    def run(self) -> None:
        """Print what is wrong, a line for each file."""
        from mereo_learning.shards import check_dataset

        check_dataset(self.dataset)


@dataclass(frozen=True)
class DatasetShow:
    """Say what a dataset is, from its manifest and the names of its files: object, seed, examples, settings.

    Attributes:
        dataset: folder written by `mereo generate`, or its URL in an object storage.
    """

    dataset: DatasetFolder

    def run(self) -> None:
        """Print a line for each fact."""
        from mereo.io.object_storage import names_in
        from mereo.scenes.seeds import TEST_SEED_START
        from mereo_learning.shards import expected_files, read_manifest

        manifest = read_manifest(self.dataset)
        files = expected_files(manifest)
        names = names_in(self.dataset)
        facts = {
            "dataset": self.dataset,
            "scene": f"{manifest['scene']}, of {', '.join(segment['name'] for segment in manifest['segments'])}",
            "seed": f"{manifest['seed']}" + ", which is for testing" * (manifest["seed"] >= TEST_SEED_START),
            "examples": f"{manifest['examples']}"
            + (f", {manifest['bytes'] / 1e6:,.1f} MB" if "bytes" in manifest else ""),
            "files": f"{sum(name in names for name in files)} of {len(files)} are there",
            "made by": f"mereo {manifest['version']}",
            **dict(flat_options(manifest["settings"])),
        }
        for name, value in facts.items():
            print(f"{name:<14} {value}")


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
    config: Annotated[TrainConfig, GROUP] = field(default_factory=TrainConfig)
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
        method: whose answer is scored: auto is what `mereo reconstruct` gives by default, with the scores of the
            network alone too; network the network alone; modes leaves the draws out.
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
    scans: Paths | None = None
    sensor: Sensor = "paper"
    image_size: ImageSize = 96
    noise_std: NotNegative = 0.1
    workspace: WorkspaceName = "own"
    terms: Annotated[SensorConfig, arg(name="sensor")] = field(default_factory=SensorConfig)
    inference: Annotated[InferenceConfig, GROUP] = EXACT
    method: AnswerMethod = "auto"
    force: bool = False
    threads: Threads = 0
    ray: RayAddress = None
    task: Annotated[TaskResources, GROUP] = DEFAULT_TASK
    json: bool = False
    options_from: ConfigFile = None

    def run(self) -> Outcome:
        """Write scores and pictures of their errors, and print the table."""
        from mereo_learning.evaluation_report import evaluate_weights
        from mereo_learning.scoring import EvaluationConfig
        from mereo_learning.tables import read_metrics

        settings = GenerateConfig(
            image_size=self.image_size, noise_std=self.noise_std, sensor=self.terms, workspace=self.workspace
        )
        evaluate_weights(
            self.weights,
            self.output,
            EvaluationConfig(self.scene, self.examples, self.seed, self.scans, settings, self.method),
            inference=self.inference,
            workers=choose_cluster(self.ray, self.threads, self.task) or 1,
            force=self.force,
            options=options_of(self, "evaluate"),
        )
        return Outcome(read_metrics(self.output / "metrics.json") if self.json else {})


@dataclass(frozen=True)
class LearnCommand:
    """Find out whether an object of yours, or each of a folder, needs training, and train it if so: extra `network`.

    First the search alone, which needs no training, is scored on test views. Where it is good enough (every view is
    explained, and mIoU is 0.85 or more, 0.5 or more in each view), that is all; else: generate, train, evaluate.

    The same command again goes on where it was stopped.

    The result is a folder for --object: scores in metrics.json and a frame to try, and where it was trained
    weights.safetensors, and a report in test.

    Attributes:
        object: a scene file (.yaml, .py), or the object's meshes as for `mereo scene new`: one for each segment, one
            file of named parts, or a label volume. Or a folder of objects: each scene file in it and each subfolder of
            meshes is one, is learnt into --output/NAME, and one that fails stops no other.
        output: folder to create; the same command continues one that was stopped.
        minutes: what all stages of an object may take together; more is better.
        train: auto trains where the search alone is not good enough; always; or never.
        init: weights to start from, a shipped name or a file; by default the shipped ones that adapt fastest.
        units: of the meshes; guessed where not given.
        workers: processes that make examples; 0 means as many as --threads.
        threads: of torch and all else that computes; 0 means one per core, and 1 helps on a busy machine.
        ray: learn each object of a folder in a task of a Ray cluster: local, one of so many --threads for this run;
            auto or HOST:PORT, the one that this machine is a node of.
        cpus_per_object: CPUs of such a task: its processes and threads.
        gpus_per_object: GPUs of such a task; 0 learns on CPUs.
        options_from: file of options, JSON or YAML, such as the config.json of a result; the command line wins over it.
    """

    object: ObjectFiles
    output: Path
    minutes: Positive = 10.0
    train: Literal["auto", "always", "never"] = "auto"
    init: str = ""
    units: LengthUnit | None = None
    workers: Workers = 0
    threads: Threads = 0
    ray: RayAddress = None
    cpus_per_object: Count = 2
    gpus_per_object: NotNegative = 0
    options_from: ConfigFile = None

    def run(self) -> None:
        """Learn, and print the scores and how to use the object."""
        from mereo_learning.learn import LearnConfig, learn, learn_objects

        workers = workers_for(self.workers, self.threads)
        config = LearnConfig(self.minutes, self.init, self.units, workers, self.train)
        if len(self.object) == 1 and self.object[0].is_dir():
            task = DEFAULT_TASK if self.ray is None else TaskResources(self.cpus_per_object, self.gpus_per_object)
            cluster = choose_cluster(self.ray, self.threads, task)
            if cluster is not None:
                config = replace(config, workers=cluster.cpus)
            learn_objects(self.object[0], self.output, config, cluster)
        elif self.ray is not None:
            raise ValueError("--ray is for a folder of objects, each of which is a task: name one, or leave it out")
        else:
            learn(self.object, self.output, config)


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
    format: ExportFormat = "onnx"
    force: bool = False

    def run(self) -> None:
        """Write the folder with both graphs of a network."""
        from mereo.api.steps import export

        export(self.weights, self.output, self.format, self.force)
