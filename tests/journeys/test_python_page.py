"""Python by example runs in its order, as one program, after the commands of the quickstart that it goes on from."""

import shlex
from pathlib import Path

import pytest
from page_blocks import ROOT, blocks

import mereo
from mereo import __main__ as command_line


@pytest.mark.slow
def test_the_lines_of_the_page_run_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("yourdfpy", reason="yourdfpy is not installed: pip install 'mereo[robot]'")
    monkeypatch.chdir(tmp_path)
    Path("examples").symlink_to(ROOT / "examples")
    (joints,) = (code for code in blocks(ROOT / "docs/quickstart.md", "sh") if "laptop.urdf" in code)
    for line in joints.splitlines()[:2]:
        command_line.main(shlex.split(line)[1:])
    values: dict[str, object] = {}
    exec(compile("".join(blocks(ROOT / "docs/python.md", "python")), "python.md", "exec"), values)
    results = [values[name] for name in ("in_base", "result", "tracked")]
    assert all(isinstance(each, mereo.Result) and each.known is True for each in results)
    assert repr(values["stored"]).startswith("StoredResult")
    assert str(values["hinge"]).startswith("86.5")
