"""``mereo`` and ``python -m mereo``: run one command, and answer what a user can cause with one line."""

import importlib.metadata
import os
import sys
from dataclasses import field, make_dataclass
from itertools import pairwise
from typing import Annotated, Any, Protocol, Union, runtime_checkable

import tyro
from tyro.conf import arg, subcommand

from mereo import commands
from mereo.config import PRESETS, TrainConfig
from mereo.experiment_command import Experiment

TRACEBACK_VARIABLE = "MEREO_TRACEBACK"
USER_ERROR, INTERRUPTED, BROKEN_PIPE = 2, 130, 141
"""Exit codes; the last two are 128 plus the signal's number, as shells report them."""


@runtime_checkable
class Command(Protocol):
    """What the arguments are read into: one of the classes of ``mereo.commands``."""

    def run(self) -> None: ...


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code. With MEREO_TRACEBACK=1 errors are raised as they are."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments in (["--version"], ["-V"]):
        print(f"mereo {version()}")
        return 0
    try:
        parse(arguments).run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _stop("mereo: interrupted", INTERRUPTED)
    except BrokenPipeError:
        # the reader (head, less) has gone; without this, flushing at exit would complain again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (ValueError, OSError, ImportError) as error:
        if os.environ.get(TRACEBACK_VARIABLE) == "1":
            raise
        return _stop(f"mereo: error: {one_line(error)}", USER_ERROR)
    return 0


def version() -> str:
    """The installed version."""
    try:
        return importlib.metadata.version("mereo")
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"


def one_line(error: Exception) -> str:
    """The error's sentence; for an error of the operating system its file and reason."""
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror[0].lower() + error.strerror[1:]
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{reason}: correct that and run the same command again"
    return " ".join(str(error).split()) or type(error).__name__


def _stop(message: str, code: int) -> int:
    sys.stdout.flush()
    print(message, file=sys.stderr)
    return code


def parse(arguments: list[str]) -> Command:
    """The command that these arguments mean; exits with 2 after a message when they mean none."""
    command: Command = tyro.cli(
        _syntax(_chosen_preset(arguments)),
        args=arguments or ["--help"],
        prog="mereo",
        description="Reconstruct deformable objects with all their segments from one depth image or point cloud. "
        "`mereo COMMAND --help` explains a command, `mereo --version` prints the version.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    return command


def _syntax(preset: str) -> Any:
    """All commands as a type that tyro reads; the defaults of ``train`` are those of the preset."""
    scene = (commands.SceneList, "list"), (commands.SceneCheck, "check"), (commands.ScenePreview, "preview")
    assets = (commands.AssetsList, "list"), (commands.AssetsGet, "get")
    return (
        Annotated[commands.Demo, subcommand("demo")]
        | Annotated[commands.Doctor, subcommand("doctor")]
        | Annotated[_group(scene), subcommand("scene", description="List, check or draw the built-in scenes.")]
        | Annotated[_group(assets), subcommand("assets", description="List or fetch downloadable meshes and scans.")]
        | Annotated[commands.Generate, subcommand("generate")]
        | Annotated[_train_from(preset), subcommand("train")]
        | Annotated[commands.Evaluate, subcommand("evaluate")]
        | Annotated[commands.Reconstruct, subcommand("reconstruct")]
        | Annotated[Experiment, subcommand("experiment")]
    )


def _train_from(preset: str) -> type[commands.Train]:
    """``Train`` whose options default to the preset's values."""
    recipe = ("config", Annotated[TrainConfig, arg(name="")], field(default=PRESETS[preset]))
    return make_dataclass(
        "Train", [recipe], bases=(commands.Train,), frozen=True, namespace={"__doc__": commands.Train.__doc__}
    )


def _group(members: tuple[tuple[type, str], ...]) -> Any:
    return Union[*(Annotated[member, subcommand(name)] for member, name in members)]


def _chosen_preset(arguments: list[str]) -> str:
    """The value of --preset, which must be known before parsing because the other defaults depend on it."""
    values = [a.partition("=")[2] for a in arguments if a.startswith("--preset=")]
    values += [after for option, after in pairwise(arguments) if option == "--preset"]
    return values[-1] if values and values[-1] in PRESETS else "base"


if __name__ == "__main__":
    sys.exit(main())
