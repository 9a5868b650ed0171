"""Extras: what libraries are needed for, said in one sentence where they are not installed."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

NEEDED = (
    "PyTorch is not installed; networks and their training need the extra `network`: run pip install 'mereo[network]', "
    "or leave the weights out, as an object's meshes or its scene are enough to find it"
)


@contextmanager
def network_needed() -> Iterator[None]:
    """Turn the lack of torch in the block into a sentence that names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise (ImportError(NEEDED) if is_torch(error) else error) from None


def is_torch(error: BaseException) -> bool:
    """Whether an error says that torch is not installed."""
    return isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "torch"


def library(name: str, extra: str, user: object) -> Any:
    """Library that an extra brings; ``ImportError`` says that ``user``, a file or a purpose, needs it."""
    try:
        return import_module(name)
    except ImportError as error:
        if not isinstance(error, ModuleNotFoundError):  # a library of the system that it needs
            raise ImportError(
                f"{user} needs {name}, which cannot be loaded ({error}): install what it lacks"
            ) from error
        raise ImportError(f"{user} needs {name}, which is not installed: pip install 'mereo[{extra}]'") from None


CURE = "is not installed: pip install 'mereo[plots]'"


def has_plots() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def pyplot() -> Any:
    """``matplotlib.pyplot``, which draws into files; ``ImportError`` without the extra `plots`."""
    try:
        import matplotlib
    except ImportError:
        raise ImportError(f"matplotlib, which draws charts, {CURE}") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    return plt
