"""Each example runs as a user would run it, in an empty folder."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
EXPECTED = {
    "desk_lamp.py": "mereo learn lamp/lamp.yaml --output learned",
    "isolate_object.py": "isolated",
    "loop.py": "wrote loop.webp: 9 frames",
    "query_points.py": "to the nearest surface",
    "reconstruct_cloud.py": "report.html",
    "sensors.py": "wrote",
    "shipped_weights.py": "wrote objects.png",
    "simulate_liver.py": "3 states of 98 nodes",
    "wrong_answers.py": "wrote wrong_answers.png",
}
ASSETS = {
    "isolate_object.py": ("bunny/bunny.off", "bunny/bun000.ply"),
    "loop.py": ("bunny/bunny.off",),
    "simulate_liver.py": ("liver/lapgym_liver_volumetric.vtk",),
    "wrong_answers.py": ("bunny/bunny.off", "human/makehuman_base.obj", "liver/lapgym_liver_visual.stl"),
}
"""Downloads that they need."""

OPTIONS = {"loop.py": ("--fps", "1"), "shipped_weights.py": ("--weights", "rope", "--cells", "24")}
"""What keeps an example short."""

LONG = (
    *("isolate_object.py", "loop.py", "reconstruct_cloud.py", "shipped_weights.py", "simulate_liver.py"),
    "wrong_answers.py",
)
"""Those that take longer; what they call has tests of its own."""

EXTRAS = {"simulate_liver.py": "mujoco"}
"""Modules that come with an extra of the package."""


def test_every_example_is_run() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in EXPECTED])
def test_example_runs(name: str, tmp_path: Path, require_asset: Callable[[str], Path]) -> None:
    for asset in ASSETS.get(name, ()):
        require_asset(asset)
    if name in EXTRAS:
        pytest.importorskip(EXTRAS[name], reason=f"{EXTRAS[name]} is not installed: pip install 'mereo[simulation]'")
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *OPTIONS.get(name, ())],
        cwd=tmp_path,
        env={**os.environ, "PYTHONWARNINGS": "error"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert EXPECTED[name] in done.stdout
