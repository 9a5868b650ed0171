"""The package keeps the order of its rooms; every rule of ``architecture`` is shown to fail on a small tree."""

import re
from collections.abc import Callable
from pathlib import Path

import architecture as rules
import pytest
from architecture import ROOMS, SATELLITES, Package, cycles, read_package, upward_imports

TOP = Path(__file__).parents[2]

Rule = Callable[[Package], list[str]]


# --- the package ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mereo() -> Package:
    return read_package(TOP / "src" / "mereo")


@pytest.mark.parametrize("rule", [upward_imports, rules.guarded_imports, cycles, rules.misplaced])
def test_the_package_keeps_its_rules(rule: Rule, mereo: Package) -> None:
    assert rule(mereo) == []


def test_settings_are_light(mereo: Package) -> None:
    light = [m for m in mereo.trees if m.rpartition("/")[2] == "config" or m == "geometry/conventions"]
    names = [f"mereo.{module.replace('/', '.')}" for module in light]
    assert len(light) > 5 and rules.heavy_libraries([*names, "mereo_learning.config"]) == []
    assert "numpy" in rules.heavy_libraries(["mereo.geometry.mesh"])


def test_the_page_names_the_rooms() -> None:
    assert set(rules.ROOM_ROW.findall((TOP / "docs" / "architecture.md").read_text("utf-8"))) == set(ROOMS)


def test_tests_lie_in_the_rooms_they_test(tmp_path: Path) -> None:
    assert rules.misplaced_tests(TOP / "tests") == []
    for name in ("geometry/test_a.py", "serving/test_b.py", "conftest.py", "test_d.py", "odd/test_e.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert rules.misplaced_tests(tmp_path) == ["tests/odd/test_e.py", "tests/test_d.py"]


@pytest.mark.parametrize("name", ["mereo", *SATELLITES])
def test_every_package_keeps_the_rules_of_names(name: str) -> None:
    package = read_package(TOP / "src" / name)
    assert rules.banned_names(package) + rules.long_signatures(package) + cycles(package) == []
    assert rules.joined_assignments(package) == []


def test_the_house_keeps_its_budget(tmp_path: Path) -> None:
    assert rules.over_budget(TOP, rules.BUDGET, rules.SIZE) == []
    assert rules.over_budget(TOP, rules.CHOICES, rules.COMPLEXITY) == []
    for name, code in {"src/a/b.py": "A = 1, -2.5, True\n\n\n", "src/c.py": "if 1:\n    b = 3 if 4 else 5"}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(code, "utf-8")
    (tmp_path / "src" / "d.md").write_text("A = 1")
    assert rules.over_budget(tmp_path, {"src": (21, 2)}, rules.SIZE) == []
    assert rules.over_budget(tmp_path, {"src": (2, 2)}, rules.COMPLEXITY) == []
    faults = rules.over_budget(tmp_path, {"src": (20, 1)}, rules.SIZE)
    faults += rules.over_budget(tmp_path, {"src": (1, 1)}, rules.COMPLEXITY)
    units = [("21 syntax nodes", 20), ("2 files", 1), ("2 decisions", 1), ("2 constants", 1)]
    assert faults == [f"src has {count}, more than {limit}: cut as much as you add" for count, limit in units]


CLOCK = re.compile(
    r"\b(?:(?:time|monotonic|perf_counter|process_time|thread_time)(?:_ns)?\(\)|(?:times|getrusage|now)\()"
)
DEADLINE = re.compile(r"^\s*(while|if) |\(\) \+ ")
"""A loop may wait for a deadline, and a process may have a timeout: they end what hangs, and assert nothing."""


def clocks(source: str) -> list[str]:
    """Lines that read a clock for something else than a deadline."""
    return [line for line in source.splitlines() if CLOCK.search(line) and not DEADLINE.search(line)]


def test_no_test_compares_a_clock_with_a_number() -> None:
    """How long work takes depends on the machine: count operations, or measure in ``benchmarks/``."""
    waiting = "end = time.monotonic() + 5\nwhile time.monotonic() < end:\n    pass"
    assert clocks(waiting) == []
    for line in ("start = time.monotonic()", "seconds.append(process_time_ns())", "return os.times().user"):
        assert clocks(f"{waiting}\n{line}") == [line]
    for path in set((TOP / "tests").rglob("*.py")) - {Path(__file__)}:
        assert clocks(path.read_text("utf-8")) == [], path


# --- that the rules can fail ------------------------------------------------------------------------------------------


def package_of(folder: Path, files: dict[str, str]) -> Package:
    """A package named mereo of these files, whose folders have an ``__init__.py`` with a docstring."""
    root = folder / "mereo"
    inits = {(parent / "__init__.py").as_posix(): '"""Room."""' for name in files for parent in Path(name).parents}
    for name, text in {**inits, **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, "utf-8")
    return read_package(root)


MESH = "geometry/mesh.py"
LATER = {"io/readers.py": "", "io/formats/ply.py": ""}
READERS, ROOT = "imports io.readers, a later room", "imports __init__, the root, which lies above all rooms"
TORCH = f"imports torch, which only {', '.join(rules.MAY_IMPORT['torch'])} may"
OBJECTS = f"imports mereo_objects, which only {', '.join(SATELLITES['mereo_objects'])} may"
LAZY = "def f():\n    from mereo_objects.assets import get"

FAULTS = [
    (upward_imports, {MESH: "import mereo.io.readers", **LATER}, [f"{MESH}:1 {READERS}"]),
    (upward_imports, {MESH: "from mereo.io import readers", **LATER}, [f"{MESH}:1 {READERS}"]),
    (upward_imports, {MESH: "def f():\n    from mereo.io.readers import read", **LATER}, [f"{MESH}:2 {READERS}"]),
    (upward_imports, {MESH: "load = lambda: import_module('mereo.io.readers')", **LATER}, [f"{MESH}:1 {READERS}"]),
    (upward_imports, {MESH: "HOMES = {'reader': 'io.readers'}", **LATER}, [f"{MESH}:1 {READERS}"]),
    (upward_imports, {MESH: "from mereo import load_model", **LATER}, [f"{MESH}:1 {ROOT}"]),
    (upward_imports, {MESH: "def f(name):\n    import_module(f'mereo.{name}')", **LATER}, [f"{MESH}:2 {ROOT}"]),
    (upward_imports, {MESH: "", "io/x.py": "import numpy\nfrom mereo.geometry.mesh import M\nX = 'mereo.json'"}, []),
    (
        rules.guarded_imports,
        {"fitting/x.py": "def f():\n    import torch.nn", "models/x.py": ""},
        [f"fitting/x.py:2 {TORCH}"],
    ),
    (rules.guarded_imports, {"io/x.py": LAZY, "scenes/registry.py": LAZY}, [f"io/x.py:2 {OBJECTS}"]),
    (
        rules.misplaced,
        {"bench/report.py": ""},
        ["bench/__init__.py lies in no room", "bench/report.py lies in no room"],
    ),
    (
        rules.misplaced,
        {"frames.py": "", "fitting/loose.py": ""},
        ["fitting/loose.py lies in no sub-room", "frames.py lies in"],
    ),
    (rules.misplaced, {"io/__init__.py": "X = 1"}, ["io/__init__.py is not its docstring alone"]),
    (rules.banned_names, {MESH: "def f(x):\n    x.said_so = 1"}, [f"{MESH}:2 defines said_so"]),
    (rules.banned_names, {MESH: "class FoundBy: pass"}, [f"{MESH}:1 defines FoundBy"]),
    (rules.banned_names, {MESH: "def f():\n    with g() as at_hand: pass"}, [f"{MESH}:2 defines at_hand"]),
    (rules.banned_names, {MESH: "def f(x):\n    raise FileNotFoundError(x.own_data)\nbone = owner = phone = 1"}, []),
    (rules.long_signatures, {MESH: "def more(a, b, c, d, e, f, *, g, h): pass"}, [f"{MESH}:1 more has 8 parameters"]),
    (rules.long_signatures, {MESH: "class A:\n    def most(self, a, b, c, d, e, f, g): pass"}, []),
    (rules.joined_assignments, {MESH: "a, b = f(c), 1"}, [f"{MESH}:1 assigns what is unlike"]),
    (rules.joined_assignments, {MESH: "a, b = f(c), f(d)\na, b = b, a.c\na.b, c = 1, d\na, b = *c, 1"}, []),
]


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_a_broken_rule_is_noticed(number: int, tmp_path: Path) -> None:
    rule, files, expected = FAULTS[number]
    faults = rule(package_of(tmp_path, files))
    assert len(faults) == len(expected)
    assert all(fault.startswith(start) for fault, start in zip(faults, expected, strict=True)), faults


@pytest.mark.parametrize("indented", ["", "def f():\n    ", "if TYPE_CHECKING:\n    "])
def test_a_circle_is_found(indented: str, tmp_path: Path) -> None:
    back = indented + "from mereo.io.a import A"
    (circle,) = cycles(package_of(tmp_path, {"io/a.py": "import mereo.io.b", "io/b.py": back}))
    assert set(circle.split(" -> ")) == {"io/a", "io/b"}


def test_each_room_is_later_than_the_one_before(tmp_path: Path) -> None:
    package = package_of(tmp_path, {f"{room}/x.py": f"from mereo import {', '.join(ROOMS)}" for room in ROOMS})
    assert len(upward_imports(package)) == len(ROOMS) * (len(ROOMS) - 1) / 2
    for room, order in rules.SUBROOMS.items():
        code = "".join(f"import mereo.{room}.{name}.x\n" for name in order)
        package = package_of(tmp_path / room, {f"{room}/{name}/x.py": code for name in order})
        assert len(upward_imports(package)) == len(order) * (len(order) - 1) / 2
