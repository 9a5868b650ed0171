"""Every option of every command, with values that it was not made for: refused by tyro's box or by one sentence."""

import io
import re
from contextlib import redirect_stdout
from functools import lru_cache

import pytest
from folder_contents import run_mereo
from fuzz import limits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mereo import __main__ as command_line
from mereo.geometry.conventions import Names

COMMANDS = (
    *("demo", "experiment sampling", "bench missing", "view missing"),
    *("scene new missing.stl", "scene check missing.yaml", "scene preview missing.yaml --output out.png"),
    *("scene modes missing.yaml", "scene export missing.yaml --output out"),
    *("generate missing.yaml --examples 2 --output out", "train missing --output out"),
    *("evaluate missing.safetensors --output out", "calibrate missing.safetensors --output out"),
    *("reconstruct missing.ply --weights missing --output out", "align missing.ply --scene missing.yaml --output out"),
    *("stream missing --weights missing --output out", "export missing --output out"),
    "release missing --output out",
)
"""A line for each command that fails for want of its input, and so whatever its other options are."""

ONLY_READ = COMMANDS[:4]
"""Commands that could start work without an input: their options are read, and no more."""

ODD = (
    *("0", "-1", "1e999", "nan", "1e-400", "9" * 400, "0x10", "1_000", "１", "1.5", "²", "", " 1", "-", "--", "="),
    *("None", "True", "\n", "\x1b[31m", "\ud800", "a" * 3000, "../..", "/dev/null", "~", "*", "[x]", "\0"),
)
VALUES = st.sampled_from(ODD) | st.text(max_size=8) | st.integers().map(str) | st.floats().map(str)


@lru_cache
def options(command: str) -> Names:
    """Names of a command's options, from its help."""
    text = io.StringIO()
    words = command.split(" missing")[0].split()
    with redirect_stdout(text), pytest.raises(SystemExit):
        run_mereo(*(words[:1] if words[0] == "experiment" else words), "--help")
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
    capfd: pytest.CaptureFixture,
) -> None:
    folder = tmp_path_factory.mktemp("options")
    read_only = command in ONLY_READ
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MEREO_ASSETS", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.with_name("cache")))

    @settings(max_examples=examples, deadline=None, database=None, derandomize=True,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.lists(st.tuples(st.sampled_from(options(command)), st.lists(VALUES, max_size=2)), min_size=1, max_size=2))
    def holds(given_options: list[tuple[str, list[str]]]) -> None:
        arguments = [*command.split(), *(word for name, values in given_options for word in (name, *values))]
        capfd.readouterr()
        with limits():
            code, boxed = run(arguments, read_only=read_only)
        printed = capfd.readouterr().err
        assert code == 2 or (code == 0 and read_only), (arguments, code, printed)
        assert not list(folder.iterdir()), arguments
        lines = [line for line in printed.split("\n") if line and not line.startswith("mereo: warning: ")]
        assert boxed or len(lines) == (0 if read_only else 1), (arguments, printed)
        assert boxed or all(line.startswith("mereo: error: ") and line.isprintable() for line in lines), arguments

    holds()
