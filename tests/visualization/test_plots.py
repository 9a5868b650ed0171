"""Charts are an extra: who asks for matplotlib, and what is said and done where it is missing."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mereo import __main__ as command_line
from mereo.visualization.color_scales import TABLE, viridis
from mereo_learning.metrics_log import MetricsLog

ROWS = [{"step": float(step), "loss": 2.0 / step, "val_iou": 0.1 * step} for step in (1, 2, 3)]


@pytest.fixture
def no_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without the extra: it is not found, and importing it fails."""
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)


def test_the_colours_are_matplotlibs() -> None:
    import matplotlib

    values = np.concatenate([np.linspace(-0.2, 1.2, 5000), np.arange(257) / 256, [0.0, 1.0]])
    theirs = matplotlib.colormaps["viridis"](values, bytes=True)[:, :3]
    np.testing.assert_array_equal(viridis(values), theirs)
    assert viridis(np.full((2, 3), np.nan)).tolist() == [[TABLE[0].tolist()] * 3] * 2


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def record(run: Path) -> MetricsLog:
    log = MetricsLog(run)
    log.rows = list(ROWS)
    log.write()
    return log


@pytest.mark.usefixtures("no_matplotlib")
def test_a_run_without_curves_is_whole_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = record(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]
    assert log.is_written(3)
    assert capsys.readouterr().out == (
        "curves.png is left out, for matplotlib, which draws it, is not installed: pip install 'mereo[plots]'\n"
    )


def test_a_run_with_curves_says_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = record(tmp_path)
    assert picture(tmp_path / "curves.png").shape == (440, 1210, 3)
    assert log.is_written(3)
    (tmp_path / "curves.png").unlink()
    assert not log.is_written(3)
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("no_matplotlib")
def test_an_experiment_asks_for_the_extra_before_it_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(["experiment", "sampling", "--output", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == (
        "mereo: error: matplotlib, which draws charts, is not installed: pip install 'mereo[plots]'\n"
    )
    assert not (tmp_path / "out").exists()
