"""The command ``mereo learn``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mereo.cli.config_file import ConfigFile
from mereo.cli.positionals import ObjectFiles
from mereo.io.bounds import Positive, Threads, Workers
from mereo.io.cores import workers_for


@dataclass(frozen=True)
class LearnCommand:
    """Learn an object of your own: check, generate, train, evaluate, in so many minutes; repeat it to go on.

    The result is weights.safetensors in the folder, with scores and a report in test, and a frame to try them on.

    Attributes:
        object: a scene file (.yaml, .py), or the object's meshes as for `mereo scene new`: one for each segment, one
            file of named parts, or a label volume.
        output: folder to create; the same command continues one that was stopped.
        minutes: what all stages may take together; more is better.
        init: weights to start from, a shipped name or a file; by default the shipped ones that adapt fastest.
        units: of the meshes; guessed where not given.
        workers: processes that make examples; 0 means as many as --threads.
        threads: of torch and all else that computes; 0 means one per core, and 1 helps on a busy machine.
        options_from: file of options, JSON or YAML, such as the config.json of a result; the command line wins over it.
    """

    object: ObjectFiles
    output: Path
    minutes: Positive = 10.0
    init: str = ""
    units: Literal["mm", "cm", "m", "in"] | None = None
    workers: Workers = 0
    threads: Threads = 0
    options_from: ConfigFile = None

    def run(self) -> None:
        """Learn, and print the scores and how to use the weights."""
        from mereo.learning.learn import learn

        learn(
            self.object,
            self.output,
            minutes=self.minutes,
            init=self.init,
            units=self.units,
            workers=workers_for(self.workers, self.threads),
        )
