"""No test compares a clock with a number: how long work takes depends on the machine and on what else it does.

Tests count instead (operations, modules, files read), and ``benchmarks/`` measures. A loop may wait for a deadline, and
a process may have a timeout: they end what hangs, and assert nothing.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

CLOCKS = {"time", "monotonic", "perf_counter", "process_time", "thread_time", "times", "getrusage", "now"}
MODULES = {"time", "os", "resource", "datetime"}


def reads_clock(node: ast.AST, clocks: set[str]) -> bool:
    """Whether an expression calls a clock, or has a name of a value that came from one."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name) and part.id in clocks:
            return True
        clock = isinstance(part, ast.Attribute) and part.attr.removesuffix("_ns") in CLOCKS
        if clock and isinstance(part.value, ast.Name) and part.value.id in MODULES:
            return True
    return False


def names_in(node: ast.AST) -> Iterator[str]:
    yield from (part.id for part in ast.walk(node) if isinstance(part, ast.Name))


def clocks_of(function: ast.AST) -> set[str]:
    """Names in a function (or a module) whose values came from a clock, through assignments and appended lists."""
    clocks: set[str] = set()
    while True:
        before = len(clocks)
        for node in ast.walk(function):
            if isinstance(node, ast.Assign) and reads_clock(node.value, clocks):
                clocks.update(name for target in node.targets for name in names_in(target))
            elif isinstance(node, (ast.AnnAssign, ast.AugAssign, ast.NamedExpr)) and node.value is not None:
                clocks.update(names_in(node.target) if reads_clock(node.value, clocks) else ())
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "append":
                clocks.update(names_in(node.func.value) if any(reads_clock(a, clocks) for a in node.args) else ())
            elif isinstance(node, ast.FunctionDef) and node is not function:
                returned = (part.value for part in ast.walk(node) if isinstance(part, ast.Return))
                clocks.update({node.name} if any(value and reads_clock(value, clocks) for value in returned) else ())
        if len(clocks) == before:
            return clocks


def comparisons_with_clocks(source: str) -> list[int]:
    """Lines of a module where an assertion reads a clock."""
    module = ast.parse(source)
    shared = {node.name for node in module.body if isinstance(node, ast.FunctionDef)} & clocks_of(module)
    found = set()
    for function in ast.walk(module):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            clocks = shared | clocks_of(function)
            found.update(
                node.lineno
                for node in ast.walk(function)
                if isinstance(node, ast.Assert) and reads_clock(node.test, clocks)
            )
    return sorted(found)


def test_no_assertion_reads_a_clock() -> None:
    lines = {path.name: comparisons_with_clocks(path.read_text()) for path in Path(__file__).parents[1].rglob("*.py")}
    assert len(lines) > 100
    assert not {name: found for name, found in lines.items() if found}, "count operations, or measure in benchmarks/"


@pytest.mark.parametrize(
    "body",
    [
        "start = time.monotonic()\n    work()\n    assert time.monotonic() - start < 2",
        "seconds = []\n    seconds.append(time.process_time())\n    assert min(seconds) < 0.5",
        "before = spent()\n    assert spent() - before < 1",
        "assert (start := time.time()) < 1",
    ],
)
def test_such_assertions_are_found(body: str) -> None:
    source = f"def spent():\n    return os.times().user\n\ndef test_it():\n    {body}\n"
    assert comparisons_with_clocks(source) == [source[: source.rindex("assert")].count("\n") + 1]


def test_waiting_is_no_assertion() -> None:
    waiting = "end = time.monotonic() + 5\n    while time.monotonic() < end:\n        pass\n    assert done()"
    assert comparisons_with_clocks(f"def test_it():\n    {waiting}\n") == []
