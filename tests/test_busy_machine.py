"""Beside other work, threads that wait must sleep: OMP_WAIT_POLICY is set early, for all, but not over a user's own."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mereo.io import busy_machine
from mereo.io.busy_machine import BusyWatch, describe_waiting

ROOT = Path(__file__).parents[1]
VARIABLE = "OMP_WAIT_POLICY"

WORKERS = f"""
import os
from mereo.workers.spread import spread

def policy(item):
    return os.environ.get({VARIABLE!r}), os.getpid()

if __name__ == "__main__":
    results = [result for _, result in spread(policy, [0, 1, 2], 2)]
    assert all(worker != os.getpid() for _, worker in results)
    print(*(value for value, _ in results))
"""

FAKE_PYTHON = f"""#!/bin/sh
# up to date whatever is asked (no installation), then tells what each of the script's commands would be run with
if [ "$1" = -c ]; then cat >/dev/null; echo same; else echo "$2 ${VARIABLE}"; fi
"""

own_value = pytest.mark.parametrize("own, expected", [(None, "passive"), ("active", "active")])


def run(command: list[str], own: str | None, **options: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command as a user who has set the variable to ``own``, or not at all."""
    variables = {name: value for name, value in os.environ.items() if name != VARIABLE}
    variables |= {} if own is None else {VARIABLE: own}
    folder = options.pop("cwd", None)
    variables |= {name: str(value) for name, value in options.items()}
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=True, timeout=120)


@own_value
def test_importing_mereo_sets_it_and_keeps_a_users_own(own: str | None, expected: str) -> None:
    code = f"import mereo, os, sys; print(os.environ[{VARIABLE!r}], 'torch' in sys.modules)"
    assert run([sys.executable, "-c", code], own).stdout.split() == [expected, "False"]


@pytest.mark.skipif(sys.platform != "linux", reason="only GNU's OpenMP tells how long it spins")
@pytest.mark.parametrize("order, spins", [("mereo, torch", False), ("torch, mereo", True)])
def test_openmp_hears_of_it_unless_torch_was_imported_before(order: str, spins: bool) -> None:
    told = run([sys.executable, "-c", f"import {order}"], None, OMP_DISPLAY_ENV="VERBOSE").stderr
    counts = [line.split("'")[1] for line in told.splitlines() if "GOMP_SPINCOUNT" in line]
    if not counts:
        pytest.skip("this torch was not built with GNU's OpenMP")
    assert [int(count) > 0 for count in counts] == [spins] * len(counts)


@own_value
def test_worker_processes_inherit_it(own: str | None, expected: str, tmp_path: Path) -> None:
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    assert run([sys.executable, str(script)], own).stdout.split() == [expected] * 3


@own_value
@pytest.mark.parametrize(
    "script, commands",
    [("./demo", ["mereo"]), ("./check", ["ruff", "ruff", "mypy", "pytest"]), (".ci/run", ["mereo", "ruff", "mypy"])],
)
def test_scripts_run_their_commands_with_it(
    script: str, commands: list[str], own: str | None, expected: str, tmp_path: Path
) -> None:
    checkout = tmp_path / "checkout"
    shutil.copytree(ROOT / ".ci", checkout / ".ci")
    for name in ("demo", "check", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, checkout)
    python = checkout / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(FAKE_PYTHON)
    python.chmod(0o755)
    (checkout / ".venv/installed").write_text("same " + extras_of_check(checkout))
    told = [line.split() for line in run([script], own, cwd=checkout).stdout.splitlines()]
    assert set(commands) <= {command for command, _ in told}
    assert {value for _, value in told} == {expected}


def extras_of_check(checkout: Path) -> str:
    """What ./check asks .ci/setup to install."""
    line = next(line for line in (checkout / "check").read_text().splitlines() if line.startswith("source .ci/setup"))
    return line.split("'")[1]


# --- while it works ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ran_s", "waited_s", "advised"),
    [
        (18.0, 2.0, None),  # two threads that hardly wait
        (2.0, 1.0, None),  # who asks for little waits for files
        (13.0, 7.0, "(--threads 1)"),
        (9.8, 9.9, "(--threads 1)"),
        (5.0, 6.0, ""),  # one thread already
    ],
)
def test_waiting_for_cores_is_told_with_the_cure(
    ran_s: float, waited_s: float, advised: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(busy_machine, "cores", lambda: 2)
    told = describe_waiting(ran_s, waited_s, 10.0)
    assert (told is None) == (advised is None)
    if told is not None and advised is not None:
        assert told.startswith(f"the machine is busy: this work waits {waited_s / (ran_s + waited_s):.0%} of its time")
        assert ("--threads" in told) == bool(advised) and advised in told and told.endswith("or wait for them")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert "--threads" not in (describe_waiting(ran_s, waited_s, 10.0) or "")


BESIDE = """
import os, subprocess, sys, time
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from mereo.io import busy_machine
from mereo.io.cores import FreeCores
busy_machine.SETTLED_S = 1.0
other = subprocess.Popen([sys.executable, "-c", "while True: pass"])
try:
    watch = busy_machine.BusyWatch()
    end = time.monotonic() + 1.2
    while time.monotonic() < end:
        pass
    print(watch.look())
    print(FreeCores().now())
    print(busy_machine.BusyWatch(watch.since - 9, watch.before).look())
finally:
    other.kill()
"""


@pytest.mark.skipif(not Path("/proc/self/schedstat").is_file(), reason="the system does not tell of it")
def test_work_beside_other_work_on_one_core_says_so_once() -> None:
    first, free, again = run([sys.executable, "-c", BESIDE], None).stdout.splitlines()
    share = int(first.partition("waits ")[2].partition("%")[0])
    assert share >= 40 and again == "None" and float(free) < 0.5


def test_where_nothing_tells_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(busy_machine, "SETTLED_S", 0.0)
    monkeypatch.setattr(busy_machine, "thread_times", dict)
    assert BusyWatch().look() is None
