"""matplotlib, which the extra `plots` brings: training curves and charts need it, and no answer does."""

from importlib.util import find_spec
from typing import Any

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
