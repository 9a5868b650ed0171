"""The package keeps the order of its rooms; every rule of ``architecture`` is shown to fail on a small tree."""

from itertools import pairwise
from pathlib import Path

import pytest
from architecture import (
    BUDGET,
    HEAVY,
    MAY_IMPORT_TORCH,
    ROOMS,
    SATELLITES,
    SUBROOMS,
    bad_init_files,
    banned_names,
    cycles,
    differences,
    heavy_settings,
    long_signatures,
    misplaced,
    misplaced_tests,
    over_budget,
    rooms_unlike_page,
    satellite_imports,
    torch_imports,
    upward_imports,
)
from package_imports import Package, read_package

TOP = Path(__file__).parents[2]

EXCEPTIONS: frozenset[str] = frozenset()
"""Imports from a later room that are still there; one that has gone must leave this list."""


# --- the package ------------------------------------------------------------------------------------------------------


def assert_none(violations: list[str]) -> None:
    assert not violations, "\n".join(violations)


@pytest.fixture(scope="module")
def mereo() -> Package:
    return read_package(TOP / "src" / "mereo")


@pytest.fixture(scope="module", params=["mereo", *SATELLITES])
def each_package(request: pytest.FixtureRequest) -> Package:
    return read_package(TOP / "src" / request.param)


def test_rooms_import_only_from_rooms_before_them(mereo: Package) -> None:
    assert_none(differences(upward_imports(mereo), EXCEPTIONS))


def test_torch_stays_where_networks_are(mereo: Package) -> None:
    assert_none(torch_imports(mereo))


def test_settings_are_light(each_package: Package) -> None:
    assert_none(heavy_settings(each_package))


def test_only_charts_ask_for_the_extra_plots(mereo: Package) -> None:
    asking = {found.source for found in mereo if found.target == "matplotlib"}
    assert asking == {"io/extras"}


def test_no_module_needs_itself(each_package: Package) -> None:
    assert_none(cycles(each_package))


def test_init_files_are_docstrings(mereo: Package) -> None:
    assert_none(bad_init_files(mereo))


def test_everything_lies_in_a_room(mereo: Package) -> None:
    assert_none(misplaced(mereo))


def test_the_page_names_the_rooms(mereo: Package) -> None:
    assert_none(rooms_unlike_page(mereo, (TOP / "docs" / "architecture.md").read_text("utf-8")))


def test_the_core_does_without_its_satellites(mereo: Package) -> None:
    assert_none(satellite_imports(mereo))


def test_tests_lie_in_the_rooms_they_test() -> None:
    assert_none(misplaced_tests(TOP / "tests"))


def test_names_are_nouns_and_verbs(each_package: Package) -> None:
    assert_none(banned_names(each_package))


def test_public_functions_have_few_parameters(each_package: Package) -> None:
    assert_none(long_signatures(each_package))


def test_the_house_keeps_its_budget() -> None:
    assert_none(over_budget(TOP, BUDGET))


# --- that the rules can fail ------------------------------------------------------------------------------------------


def package_of(folder: Path, files: dict[str, str]) -> Package:
    """A package named mereo of these files, whose folders have an ``__init__.py`` with a docstring."""
    root = folder / "mereo"
    inits = {(parent / "__init__.py").as_posix(): '"""Room."""' for name in files for parent in Path(name).parents}
    for name, text in {**inits, **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, "utf-8")
    return read_package(root)


LATER = {"io/readers.py": "", "io/formats/ply.py": ""}

UPWARD = {
    "a statement": ("import mereo.io.readers", "io.readers"),
    "a name of a module": ("from mereo.io.readers import read", "io.readers"),
    "a module of a room": ("from mereo.io import readers", "io.readers"),
    "a whole room": ("from mereo import io", "io.__init__"),
    "a relative import": ("from ..io.formats import ply", "io.formats.ply"),
    "a lazy import": ("def f():\n    from mereo.io.readers import read", "io.readers"),
    "an import for type checkers": ("if TYPE_CHECKING:\n    from mereo.io.readers import Reader", "io.readers"),
    "a string": ("load = lambda: import_module('mereo.io.readers')", "io.readers"),
    "an f-string": ("def f(name):\n    import_module(f'mereo.io.formats.{name}')", "io.formats.__init__"),
    "a table": ("HOMES = {'ply': 'io.formats.ply'}", "io.formats.ply"),
    "the public names": ("from mereo import load_model", "__init__"),
    "an open f-string": ("def f(name):\n    import_module(f'mereo.{name}')", "__init__"),
}


@pytest.mark.parametrize("way", UPWARD)
def test_an_upward_import_is_found(way: str, tmp_path: Path) -> None:
    code, target = UPWARD[way]
    package = package_of(tmp_path, {"geometry/mesh.py": code, **LATER})
    rule = "the root, which lies above all rooms" if target == "__init__" else "a later room"
    line = code.count("\n") + 1
    assert differences(upward_imports(package), ()) == [f"geometry/mesh.py:{line} imports {target}, {rule}"]


@pytest.mark.parametrize(
    "code",
    [
        "from mereo.geometry.mesh import Mesh",
        "from mereo.io.formats import ply",
        "import numpy\nfrom models.network import x",
        "NAMES = ('training.csv', 'mereo.json', 'of mereo.models.network', 'numpy.float32')",
    ],
)
def test_other_imports_and_strings_are_free(code: str, tmp_path: Path) -> None:
    files = {"geometry/mesh.py": "", "models/network.py": ""}
    package = package_of(tmp_path, {**files, **LATER, "io/readers.py": code})
    assert upward_imports(package) == []


@pytest.mark.parametrize("module", ["__init__.py", "__main__.py"])
def test_the_root_imports_every_room(module: str, tmp_path: Path) -> None:
    code = f"from mereo import {', '.join(ROOMS)}"
    package = package_of(tmp_path, {**{f"{room}/x.py": "" for room in ROOMS}, module: code})
    assert len(list(package)) == len(ROOMS)
    assert upward_imports(package) == []


def test_each_room_is_later_than_the_one_before(tmp_path: Path) -> None:
    package = package_of(tmp_path, {f"{room}/x.py": f"from mereo import {', '.join(ROOMS)}" for room in ROOMS})
    count = len(ROOMS)
    assert len(upward_imports(package)) == count * (count - 1) / 2


def test_each_subroom_is_later_than_the_one_before(tmp_path: Path) -> None:
    for room, order in SUBROOMS.items():
        code = "".join(f"import mereo.{room}.{name}.x\n" for name in order)
        package = package_of(tmp_path, {f"{room}/{name}/x.py": code for name in order})
        assert len(upward_imports(package)) == len(order) * (len(order) - 1) / 2
        first = f"{room}/{order[0]}/x.py:2 imports {room}.{order[1]}.x, a later room"
        assert first in differences(upward_imports(package), ())


def test_exceptions_pass_until_they_are_stale(tmp_path: Path) -> None:
    upward = upward_imports(package_of(tmp_path, {"geometry/mesh.py": "import mereo.io.readers", **LATER}))
    assert differences(upward, {"geometry/mesh -> io/readers"}) == []
    stale = "geometry/mesh -> io/writers is listed as an exception and no longer there: delete it"
    assert differences(upward, {"geometry/mesh -> io/readers", "geometry/mesh -> io/writers"}) == [stale]


@pytest.mark.parametrize(
    "code",
    ["import torch.nn", "from torch import Tensor", "def f():\n    import torch", "m = import_module('torch.nn')"],
)
def test_torch_elsewhere_is_found(code: str, tmp_path: Path) -> None:
    allowed = ("models/rigid_alignment.py", "cli/tools.py")
    free = ("fitting/registration/fit.py", "cli/demo.py", "__main__.py")
    package = package_of(tmp_path, dict.fromkeys((*allowed, *free), code))
    rule = f"imports torch, which only {', '.join(MAY_IMPORT_TORCH)} may"
    line = code.count("\n") + 1
    assert sorted(torch_imports(package)) == sorted(f"{name}:{line} {rule}" for name in free)


@pytest.mark.parametrize("library", HEAVY)
@pytest.mark.parametrize("settings", ["io/config", "io/writers/config", "geometry/conventions"])
def test_heavy_settings_are_found(settings: str, library: str, tmp_path: Path) -> None:
    files = {
        "io/a.py": "from mereo.io import b",
        "io/b.py": f"if TYPE_CHECKING:\n    pass\nelse:\n    import {library}",
    }
    package = package_of(tmp_path, {**files, f"{settings}.py": "from mereo.io.a import A"})
    assert heavy_settings(package) == [f"{settings}.py loads {library}: {settings} -> io/a -> io/b -> {library}"]


@pytest.mark.parametrize(
    "code", ["def f():\n    import numpy", "if TYPE_CHECKING:\n    import numpy", "from mereo.io.lazy import x"]
)
def test_settings_may_name_what_they_do_not_load(code: str, tmp_path: Path) -> None:
    package = package_of(tmp_path, {"io/config.py": code, "io/lazy.py": "class A:\n    def f(self): import numpy"})
    assert heavy_settings(package) == []


def test_cycles_are_found(tmp_path: Path) -> None:
    files = {"io/a.py": "import mereo.io.b", "io/b.py": "try:\n    import mereo.io.c\nfinally: pass"}
    assert cycles(package_of(tmp_path, {**files, "io/c.py": "def f():\n    import mereo.io.a"})) == []
    (found,) = cycles(package_of(tmp_path, {**files, "io/c.py": "class C:\n    from mereo.io.a import A"}))
    assert set(pairwise(found.split(" -> "))) == {("io/a", "io/b"), ("io/b", "io/c"), ("io/c", "io/a")}


@pytest.mark.parametrize(
    "text, fault",
    [("", "has no docstring"), ("X = 1", "has no docstring"), ('"""Room."""\nX = 1', "holds more than its docstring")],
)
def test_other_init_files_are_found(text: str, fault: str, tmp_path: Path) -> None:
    package = package_of(tmp_path, {"io/readers.py": "", "io/writers/__init__.py": text, "__init__.py": "X = 1"})
    assert bad_init_files(package) == [f"io/writers/__init__.py {fault}"]
    (package.root / "io/__init__.py").unlink()
    assert "io/__init__.py is missing" in bad_init_files(read_package(package.root))


def test_what_lies_in_no_room_is_found(tmp_path: Path) -> None:
    files = {"bench/report.py": "", "weights/rope.json": "{}", "states/load.py": "", "frames.py": "", "__main__.py": ""}
    files |= {"fitting/config.py": "", "fitting/modes/fit.py": "", "fitting/loose.py": "", "fitting/other/x.py": ""}
    root = package_of(tmp_path, {"io/readers.py": "", **files}).root
    (root / "weights/__init__.py").unlink()
    (root / "states/__init__.py").unlink()
    (root / "gpu/__pycache__").mkdir(parents=True)
    (root / "gpu/__pycache__/kernels.pyc").touch()
    assert misplaced(read_package(root)) == [
        "bench/ is neither a room nor a folder of data",
        "states/load.py is code in a folder of data",
        "frames.py lies at the root and not in a room",
        "fitting/loose.py lies in no sub-room",
        "fitting/other/__init__.py lies in no sub-room",
        "fitting/other/x.py lies in no sub-room",
    ]


def test_another_table_of_rooms_is_found(tmp_path: Path) -> None:
    package = package_of(tmp_path, {"io/readers.py": "", "cli/demo.py": ""})
    table = "| room | what it holds |\n|---|---|\n| `io/` | files |\n"
    assert (
        rooms_unlike_page(package, table + "| [`cli/`](src/mereo/cli) | commands |\n\n| other | `geometry/` |\n") == []
    )
    assert rooms_unlike_page(package, table + "| `bench/` | speed |\n") == [
        "the table of rooms leaves out cli/",
        "the table of rooms names bench/, which is no room",
    ]


def test_an_import_of_a_satellite_is_found(tmp_path: Path) -> None:
    code = "def f():\n    from mereo_objects.assets import get"
    package = package_of(tmp_path, {"scenes/registry.py": code, "cli/demo.py": code, "io/readers.py": code})
    assert satellite_imports(package) == [
        "io/readers.py:2 imports mereo_objects, which only cli/, scenes/registry.py may"
    ]


def test_an_exceeded_budget_is_found(tmp_path: Path) -> None:
    for name, lines in {"src/a/b.py": 3, "src/c.py": 2, "docs/d.py": 999}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("#\n" * lines, "utf-8")
    assert over_budget(tmp_path, {"src": (5, 2)}) == []
    assert over_budget(tmp_path, {"src": (4, 1)}) == [
        "src has 5 lines, more than 4: cut as much as you add",
        "src has 2 files, more than 1: merge two that are one idea",
    ]


def test_a_test_outside_of_the_rooms_is_found(tmp_path: Path) -> None:
    for name in (
        "geometry/test_a.py",
        "serving/test_b.py",
        "house/test_c.py",
        "conftest.py",
        "test_d.py",
        "odd/test_e.py",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [fault.split(" lies")[0] for fault in misplaced_tests(tmp_path)] == [
        "tests/odd/test_e.py",
        "tests/test_d.py",
    ]


@pytest.mark.parametrize(
    "code",
    [
        "found = 1",
        "def f(one): pass",
        "for own_name in (): pass",
        "class FoundBy: pass",
        "import os as there",
        "def told(): pass",
        "def f(x):\n    x.said_so = 1",
        "def f():\n    with g() as at_hand: pass",
    ],
)
def test_a_banned_word_is_found_in_each_kind_of_name(code: str, tmp_path: Path) -> None:
    assert len(banned_names(package_of(tmp_path, {"geometry/mesh.py": code}))) == 1


def test_names_of_others_are_free(tmp_path: Path) -> None:
    code = "def f(x):\n    raise FileNotFoundError(x.own_data_is_not_used, __file__)\nbone = owner = phone = 1"
    assert banned_names(package_of(tmp_path, {"geometry/mesh.py": code})) == []


def test_the_eighth_parameter_is_found(tmp_path: Path) -> None:
    code = """
def most(a, b, c, d, e, f, *, g): pass
def more(a, b, c, d, e, f, *, g, h): pass
def _hidden(a, b, c, d, e, f, *, g, h): pass
class A:
    def method(self, a, b, c, d, e, f, g): pass
"""
    faults = long_signatures(package_of(tmp_path, {"geometry/mesh.py": code}))
    assert faults == ["geometry/mesh.py:3 more has 8 parameters, more than 7"]
