"""``mereo`` and ``python -m mereo``: run one command, and answer what a user can cause with one line."""

import importlib.metadata
import io
import os
import sys
import warnings
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import field, make_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, Union, runtime_checkable

import tyro
from tyro.conf import subcommand

from mereo.api.words import option_words
from mereo.cli import commands, dataset_commands, scene_commands, tool_commands, weights_commands, weights_hub_commands
from mereo.cli.calibrate import CalibrateCommand
from mereo.cli.config_file import GivenOptions, defaults_from, read_options
from mereo.cli.last_resort import sentence
from mereo.cli.learn import LearnCommand
from mereo.cli.outcome import Outcome
from mereo.cli.reconstruct_command import ReconstructCommand
from mereo.cli.serve_command import ServeCommand
from mereo.cli.stop_signals import Stopped, stop_signals
from mereo.cli.usage import noted_events, usage_sentence
from mereo.cli.view_command import ViewCommand
from mereo.io.bounds import check_bounds
from mereo.io.cores import use_threads
from mereo.io.foreseen import is_foreseen, printable_line, words_of
from mereo.synthesis.config import SENSORS, GenerateConfig, SensorConfig
from mereo.training.config import PRESETS, TrainConfig

Choice = TypeVar("Choice")

TRACEBACK_VARIABLE = "MEREO_TRACEBACK"
"""Environment variable that shows where an error comes from."""

CONFIGURABLE = ("generate", "train", "evaluate", "reconstruct", "learn")
"""Commands with the option --config."""

AS_JSON = (commands.Demo, commands.Evaluate, ReconstructCommand)
"""Commands that leave an outcome, which ``--json`` prints; others print their own."""

USER_ERROR, FAULT, INTERRUPTED, BROKEN_PIPE = 2, 70, 130, 141
"""Exit codes; 70 is EX_SOFTWARE of sysexits.h, the last two are 128 plus the signal's number, as shells report them."""


@runtime_checkable
class Command(Protocol):
    """Command that arguments are read into: a class of ``commands``, ``scene_commands`` or ``tool_commands``."""

    def run(self) -> Outcome | None:
        """Do the work, and print what a person wants to know of it."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit code. With MEREO_TRACEBACK=1 errors are raised as they are."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments in (["--version"], ["-V"]):
        print(f"mereo {version()}")
        return 0
    warnings.formatwarning = _warning_line
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal that lacks a character gets another one, and no error
        sys.stdout.reconfigure(errors="replace")
    try:
        with option_words(), stop_signals():
            command = parse(arguments)
            use_threads(getattr(command, "threads", 0))
            status = _run(command)
            sys.stdout.flush()
    except Stopped as stopped:
        return _stop(f"mereo: stopped by {stopped.signal.name}", 128 + stopped.signal)
    except KeyboardInterrupt:
        return _stop("mereo: interrupted", INTERRUPTED)
    except BrokenPipeError:
        # the reader (head, less) has gone; without this, flushing at exit would complain again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        if os.environ.get(TRACEBACK_VARIABLE) == "1":
            raise
        if is_foreseen(error):
            return _stop(f"mereo: error: {words_of(error)}", USER_ERROR)
        return _stop(f"mereo: error: {sentence(error, arguments, TRACEBACK_VARIABLE)}", FAULT)
    return status


def _run(command: Command) -> int:
    """Run a command, and return its exit status; with ``--json`` standard output gets one object and nothing else."""
    as_json = isinstance(command, AS_JSON) and command.json
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        outcome = command.run()
    if outcome is None:
        return 0
    if as_json:
        from mereo.io.atomic_files import json_text

        print(json_text(outcome.facts), end="")
    return outcome.status


def version() -> str:
    """Version of the installed package, or that there is none."""
    try:
        return importlib.metadata.version("mereo")
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"


def _warning_line(message: Warning | str, *_: Any, **__: Any) -> str:
    return f"mereo: warning: {printable_line(str(message))}\n"


def _stop(message: str, code: int) -> int:
    with suppress(OSError):  # a terminal that was closed (HUP) takes no words
        sys.stdout.flush()
        print(message, file=sys.stderr)
    return code


def parse(arguments: list[str]) -> Command:
    """Command that these arguments mean; exits with 0 after a help that they ask for.

    Raises ``ValueError`` for arguments that mean none, and for settings that are refused, such as a number out of its
    bounds.
    """
    said = io.StringIO()
    with noted_events() as events:
        try:
            with redirect_stderr(said):
                command = _read(arguments)
        except SystemExit as end:
            if not end.code:
                raise
            refused = end.__context__
            while refused is not None and not (isinstance(refused, ValueError) and is_foreseen(refused)):
                refused = refused.__context__
            if refused is None:
                refused = ValueError(usage_sentence(arguments, events, said.getvalue(), _help))
            raise refused from None  # tyro frames what it says; the sentence is enough by itself
    check_bounds(command, "--")
    return command


@cache
def _help(*words: str) -> str:
    """Help on the command of these words."""
    said = io.StringIO()
    with redirect_stdout(said), suppress(SystemExit):
        _read([*words, "--help"])
    return said.getvalue()


def _read(arguments: list[str]) -> Command:
    """Command that tyro makes of these arguments, which exits where it cannot."""
    given = _options_from(arguments)
    recipe = _chosen(arguments, "--preset", PRESETS, (given and given.choice("preset")) or "base")
    sensor = _chosen(arguments, "--sensor", SENSORS, (given and given.choice("sensor")) or "paper")
    command: Command = tyro.cli(
        _syntax(recipe, sensor, given),
        args=arguments or ["--help"],
        prog="mereo",
        description="Reconstruct deformable objects with all their segments from one depth image or point cloud. "
        "`mereo COMMAND --help` explains a command, `mereo --version` prints the version.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    return command


def _syntax(recipe: TrainConfig, sensor: SensorConfig, given: GivenOptions | None) -> Any:
    """All commands as a type that tyro reads.

    ``train`` starts from this recipe, what renders from this sensor, and the command of a file of options from that.
    """

    def starting(command: type, name: str, **defaults: Any) -> Any:
        own = given if given is not None and given.command == name else None
        return Annotated[_starting(command, own, defaults), subcommand(name)]

    scene = (
        (scene_commands.SceneList, "list"),
        (scene_commands.SceneNew, "new"),
        (scene_commands.SceneCheck, "check"),
        (scene_commands.ScenePreview, "preview"),
        (scene_commands.SceneModes, "modes"),
        (scene_commands.SceneExport, "export"),
        (scene_commands.SceneRecord, "record"),
    )
    weights = (
        (weights_commands.WeightsList, "list"),
        (weights_commands.WeightsShow, "show"),
        (weights_hub_commands.WeightsPush, "push"),
        (weights_hub_commands.WeightsPull, "pull"),
    )
    datasets = (dataset_commands.DatasetCheck, "check"), (dataset_commands.DatasetShow, "show")
    assets = (commands.AssetsList, "list"), (commands.AssetsGet, "get")
    return (
        Annotated[commands.Demo, subcommand("demo")]
        | Annotated[commands.Doctor, subcommand("doctor")]
        | starting(LearnCommand, "learn")
        | Annotated[
            _group(scene), subcommand("scene", description="List, write, check, draw, record or export scenes.")
        ]
        | Annotated[_group(assets), subcommand("assets", description="List or fetch downloadable meshes and scans.")]
        | Annotated[_group(weights), subcommand("weights", description="List, show, publish or fetch weights.")]
        | starting(commands.Generate, "generate", settings=GenerateConfig(sensor=sensor))
        | Annotated[_group(datasets), subcommand("dataset", description="Check or describe generated examples.")]
        | starting(commands.Train, "train", config=recipe)
        | starting(commands.Evaluate, "evaluate", terms=sensor)
        | Annotated[CalibrateCommand, subcommand("calibrate")]
        | starting(ReconstructCommand, "reconstruct")
        | Annotated[tool_commands.Align, subcommand("align")]
        | Annotated[ViewCommand, subcommand("view")]
        | Annotated[tool_commands.StreamCommand, subcommand("stream")]
        | Annotated[ServeCommand, subcommand("serve")]
        | Annotated[commands.Export, subcommand("export")]
        | Annotated[tool_commands.Experiment, subcommand("experiment")]
        | Annotated[tool_commands.BenchCommand, subcommand("bench")]
        | Annotated[tool_commands.Release, subcommand("release")]
    )


def _starting(command: type, given: GivenOptions | None, defaults: Mapping[str, Any]) -> type:
    """Command with other defaults, those of a file of options before the others; itself where there are none."""
    if given is not None:
        defaults = defaults_from(command, given, defaults)
    if not defaults:
        return command
    changed = [(name, command.__annotations__[name], field(default=value)) for name, value in defaults.items()]
    # by keyword alone, as options that have got a default come before some without
    return make_dataclass(
        command.__name__, changed, bases=(command,), frozen=True, kw_only=True, namespace={"__doc__": command.__doc__}
    )


def _options_from(arguments: list[str]) -> GivenOptions | None:
    """Options of the file that --config names, for the command that takes them."""
    files = _values(arguments, "--config")
    return read_options(Path(files[-1]), arguments[0]) if files and arguments[0] in CONFIGURABLE else None


def _group(members: tuple[tuple[type, str], ...]) -> Any:
    return Union[*(Annotated[member, subcommand(name)] for member, name in members)]


def _chosen(arguments: list[str], option: str, choices: Mapping[Any, Choice], otherwise: str) -> Choice:
    """Choice of an option, which must be known before parsing because the other defaults depend on it."""
    values = _values(arguments, option)
    return choices[values[-1] if values and values[-1] in choices else otherwise]


def _values(arguments: list[str], option: str) -> list[str]:
    """All values that an option is given."""
    values = [a.partition("=")[2] for a in arguments if a.startswith(f"{option}=")]
    return values + [after for before, after in pairwise(arguments) if before == option]


if __name__ == "__main__":
    sys.exit(main())
