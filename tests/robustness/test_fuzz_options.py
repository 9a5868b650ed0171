"""Every option of every command, with values that it was not made for: refused by tyro's box or by one sentence."""

import io
import re
from contextlib import redirect_stdout
from functools import lru_cache

import pytest
from fuzz_rule import limits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mereo import __main__ as command_line

COMMANDS = {
    "demo": "demo",
    "scene new": "scene new missing.stl",
    "scene check": "scene check missing.yaml",
    "scene preview": "scene preview missing.yaml --output out.png",
    "scene modes": "scene modes missing.yaml",
    "scene export": "scene export missing.yaml --output out",
    "generate": "generate missing.yaml --examples 2 --output out",
    "train": "train missing --output out",
    "evaluate": "evaluate missing.safetensors --output out",
    "calibrate": "calibrate missing.safetensors --output out",
    "reconstruct": "reconstruct missing.ply --weights missing --output out",
    "align": "align missing.ply --scene missing.yaml --output out",
    "view": "view missing",
    "stream": "stream missing --weights missing --output out",
    "export": "export missing --output out",
    "experiment": "experiment sampling",
    "bench": "bench missing",
    "release": "release missing --output out",
}
"""A line for each command that fails for want of its input, and so whatever its other options are."""

ONLY_READ = ("demo", "experiment", "bench", "view")
"""Commands that could start work without an input: their options are read, and no more."""

CHECKS = list(HealthCheck)  # of hypothesis: fixtures that stay the same, and slow examples, are meant

NUMBERS = ("0", "-1", "1e999", "-1e999", "nan", "NaN", "1e-400", "9" * 400, "0x10", "1_000", "１", "1.5", "²", "", " 1")
WORDS = (
    "",
    "-",
    "--",
    "=",
    "None",
    "True",
    "\n",
    "\x1b[31m",
    "\ud800",
    "a" * 3000,
    "../..",
    "/dev/null",
    "~",
    "*",
    "[x]",
    "\0",
)
VALUES = st.sampled_from((*NUMBERS, *WORDS)) | st.text(max_size=8) | st.integers().map(str) | st.floats().map(str)


@lru_cache
def options(command: str) -> tuple[str, ...]:
    """Names of a command's options, from its help."""
    text = io.StringIO()
    with redirect_stdout(text), pytest.raises(SystemExit):
        command_line.main([*command.split(), "--help"])
    found = set(re.findall(r"--[a-z][a-z0-9.-]*[a-z0-9]", text.getvalue())) - {"--help"}
    assert found
    return tuple(sorted(found))


def run(arguments: list[str], *, read_only: bool) -> tuple[int, bool]:
    """Exit code of a command, or of reading its arguments, and whether tyro refused them."""
    try:
        return (command_line.parse(arguments) and 0) if read_only else command_line.main(arguments), False
    except SystemExit as end:
        return int(end.code or 0), True
    except ValueError as error:
        return 2 if command_line.is_foreseen(error) else 70, False


@pytest.mark.parametrize("examples", [4, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("command", COMMANDS)
def test_odd_values_of_options_are_refused(
    command: str,
    examples: int,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path_factory.mktemp("options")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MEREO_ASSETS", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.with_name("cache")))

    @settings(max_examples=examples, deadline=None, database=None, derandomize=True, suppress_health_check=CHECKS)
    @given(st.lists(st.tuples(st.sampled_from(options(command)), st.lists(VALUES, max_size=2)), min_size=1, max_size=2))
    def holds(given_options: list[tuple[str, list[str]]]) -> None:
        arguments = [*COMMANDS[command].split(), *(word for name, values in given_options for word in (name, *values))]
        capfd.readouterr()
        with limits():
            code, boxed = run(arguments, read_only=command in ONLY_READ)
        said = capfd.readouterr().err
        assert code == 2 or (code == 0 and command in ONLY_READ), (arguments, code, said)
        assert not list(folder.iterdir()), arguments
        if boxed:
            return
        lines = [line for line in said.split("\n") if line and not line.startswith("mereo: warning: ")]
        assert len(lines) == (0 if command in ONLY_READ else 1), (arguments, said)
        assert all(line.startswith("mereo: error: ") and line.isprintable() for line in lines), (arguments, said)

    holds()
