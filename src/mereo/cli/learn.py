"""The command ``mereo learn``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mereo.cli.config_file import ConfigFile
from mereo.cli.options import ObjectFiles
from mereo.io.bounds import Count, NotNegative, Positive, Threads, Workers
from mereo.io.cores import workers_for
from mereo.workers.config import RayAddress, TaskResources, cluster_of


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
    units: Literal["mm", "cm", "m", "in"] | None = None
    workers: Workers = 0
    threads: Threads = 0
    ray: RayAddress = None
    cpus_per_object: Count = 2
    gpus_per_object: NotNegative = 0
    options_from: ConfigFile = None

    def run(self) -> None:
        """Learn, and print the scores and how to use the object."""
        from mereo.api.steps import learn
        from mereo.learning.object_folders import is_folder_of_objects, learn_objects
        from mereo.workers.cluster import joined_first

        workers = workers_for(self.workers, self.threads)
        if not is_folder_of_objects(self.object):
            if self.ray is not None:
                raise ValueError("--ray is for a folder of objects, each of which is a task: name one, or leave it out")
            learn(
                self.object,
                self.output,
                minutes=self.minutes,
                init=self.init,
                units=self.units,
                workers=workers,
                train=self.train,
            )
            return
        task = TaskResources(self.cpus_per_object, self.gpus_per_object)
        cluster = None if self.ray is None else cluster_of(self.ray, self.threads, task)
        with joined_first(cluster):
            learn_objects(
                self.object[0],
                self.output,
                minutes=self.minutes,
                init=self.init,
                units=self.units,
                workers=workers,
                train=self.train,
                cluster=cluster,
            )
