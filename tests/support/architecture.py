"""The rules of the package's rooms.

Every rule is a function of what ``read_package`` returns, or of files, and answers with its violations, one readable
sentence each. An empty list means that the rule holds.
"""

import ast
import re
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from package_imports import Import, Package

ROOMS = (
    "geometry",
    "io",
    "workers",
    "deformation",
    "scenes",
    "synthesis",
    "models",
    "reconstruction",
    "fitting",
    "visualization",
    "api",
    "cli",
)
"""From the ground up: a room imports only from itself and from those before it."""

SUBROOMS = {"fitting": ("config", "problem", "modes", "search", "draws", "uncertainty", "registration", "tracking")}
"""Rooms whose sub-rooms, and modules beside them, have an order too: all of the room lies in one of these."""

DATA_FOLDERS = ("frames", "states", "weights")
"""They travel with the package and hold no code."""

ROOT_MODULES = ("__init__", "__main__")
"""The public names and the entry point, which may import every room."""

MAY_IMPORT_TORCH = ("models/", "cli/tools.py")

HEAVY = ("numpy", "torch", "scipy", "trimesh", "matplotlib")
"""What settings must not load, so that ``--help`` is instant: the two, and libraries that bring them."""

SATELLITES = {
    "mereo_learning": ("api/generate.py", "api/steps.py", "cli/", "__init__.py", "__main__.py"),
    "mereo_objects": ("cli/", "scenes/registry.py"),
    "mereo_serving": ("cli/",),
    "mereo_viewer": ("api/", "cli/"),
    "mereo_experiments": ("cli/",),
}
"""Packages beside mereo, in the same wheel, and the modules of mereo that may import each."""

BUDGET = {"src/mereo": (43748, 185), "tests": (35121, 231)}
"""Lines and files that a folder may have at most; they fall to 35,000 and 200, and to 25,000 lines of tests."""

TEST_FOLDERS = ("theorems", "journeys", "robustness", "house", "support")
"""Folders of tests beside those of the rooms: see CONTRIBUTING.md."""

BANNED = frozenset(
    ("told", "said", "asked", "found", "one", "beside", "anew", "elsewhere", "wish", "here", "there", "own")
)
"""Words that no name of ours has as a part: they need a noun, which is then the better name (docs/glossary.md)."""

MOST_PARAMETERS = 7
"""Of a public function; more are a value that its callers have."""

ROOM_ROW = re.compile(r"^\| *\[?`(\w+)/`", re.MULTILINE)
"""How a row of the table of rooms in docs/architecture.md begins; the room's name may be a link."""


# --- rules of imports -------------------------------------------------------------------------------------------------


def upward_imports(package: Package) -> list[Import]:
    """Imports from a later room or sub-room, or from the root: lazy ones, for type checkers and in strings included."""
    inside = [i for i in package if i.target in package.trees and i.source not in ROOT_MODULES]
    return [i for i in inside if _height(i.target) > _height(i.source)]


def _height(module: str) -> tuple[int, int]:
    """Place of the module's room in ``ROOMS``, then of its sub-room; what lies in none of them comes after all."""
    room, inside, *_ = *module.split("/"), ""
    return _place(room, ROOMS), _place(inside, SUBROOMS.get(room, ()))


def _place(name: str, order: tuple[str, ...]) -> int:
    return order.index(name) if name in order else len(order)


def differences(upward: Iterable[Import], exceptions: Collection[str]) -> list[str]:
    """Upward imports that are no known exception (``Import.edge``), and known exceptions that are no longer there."""
    new = dict.fromkeys(_upward_sentence(i) for i in upward if i.edge not in exceptions)
    stale = sorted(set(exceptions) - {i.edge for i in upward})
    return [*new, *(f"{edge} is listed as an exception and no longer there: delete it" for edge in stale)]


def _upward_sentence(found: Import) -> str:
    rule = "a later room" if "/" in found.target else "the root, which lies above all rooms"
    return f"{found.place} imports {found.target.replace('/', '.')}, {rule}"


def torch_imports(package: Package) -> list[str]:
    """Imports of torch, lazy ones included, in rooms that do without."""
    return [
        f"{i.place} imports torch, which only {', '.join(MAY_IMPORT_TORCH)} may"
        for i in package
        if i.target == "torch" and not f"{i.source}.py".startswith(MAY_IMPORT_TORCH)
    ]


def heavy_settings(package: Package) -> list[str]:
    """Modules of settings and conventions that load a heavy library, by themselves or through others."""
    light = [m for m in package.trees if m.rpartition("/")[2] == "config" or m == "geometry/conventions"]
    chains = [_chain_to_heavy(package, module) for module in light]
    return [f"{chain[0]}.py loads {chain[-1]}: {' -> '.join(chain)}" for chain in chains if chain]


def _chain_to_heavy(package: Package, module: str) -> list[str]:
    """A shortest chain of imports from a module to a heavy library; empty where there is none."""
    chains, seen = deque([[module]]), {module}
    while chains:
        chain = chains.popleft()
        if chain[-1] in HEAVY:
            return chain
        for name in package.needs(chain[-1]):
            if name not in seen:
                seen.add(name)
                chains.append([*chain, name])
    return []


def cycles(package: Package) -> list[str]:
    """Circles of modules that import each other at the start; cutting those named would leave none."""
    graph = {module: {name for name in package.needs(module) if name in package.trees} for module in package.trees}
    found: list[str] = []
    while True:
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            circle = error.args[1][::-1]  # now each imports the next
            found.append(" -> ".join(circle))
            graph[circle[0]].discard(circle[1])
        else:
            return found


# --- rules of files ---------------------------------------------------------------------------------------------------


def bad_init_files(package: Package) -> list[str]:
    """Folders of modules below the root whose ``__init__.py`` is missing or is not just a docstring."""
    folders = sorted({module.rpartition("/")[0] for module in package.trees if "/" in module})
    faults = {folder: _init_fault(package.trees.get(f"{folder}/__init__")) for folder in folders}
    return [f"{folder}/__init__.py {fault}" for folder, fault in faults.items() if fault]


def _init_fault(tree: ast.Module | None) -> str:
    if tree is None:
        return "is missing"
    if ast.get_docstring(tree) is None:
        return "has no docstring"
    return "holds more than its docstring" if len(tree.body) > 1 else ""


def misplaced(package: Package) -> list[str]:
    """Folders that are neither a room nor data, code among the data, and modules that belong in a room or sub-room."""
    strange = [folder for folder in _folders(package) if folder not in (*ROOMS, *DATA_FOLDERS)]
    code = [module for module in package.trees if module.startswith(tuple(f"{d}/" for d in DATA_FOLDERS))]
    loose = [module for module in package.trees if "/" not in module and module not in ROOT_MODULES]
    homeless = [module for module in package.trees if _in_no_subroom(module)]
    return [
        *(f"{folder}/ is neither a room nor a folder of data" for folder in strange),
        *(f"{module}.py is code in a folder of data" for module in code),
        *(f"{module}.py lies at the root and not in a room" for module in loose),
        *(f"{module}.py lies in no sub-room" for module in homeless),
    ]


def _in_no_subroom(module: str) -> bool:
    room, inside, *_ = *module.split("/"), ""
    return room in SUBROOMS and inside not in (*SUBROOMS[room], "__init__")


def _folders(package: Package) -> list[str]:
    """Folders directly below the root that hold files; caches that deleted modules left do not count."""
    files = [file.relative_to(package.root).parts for file in package.root.rglob("*") if file.is_file()]
    return sorted({parts[0] for parts in files if len(parts) > 1 and "__pycache__" not in parts})


def rooms_unlike_page(package: Package, page: str) -> list[str]:
    """Rooms that the page's table of rooms leaves out, and rows of it that are no room of the package."""
    named, there = set(ROOM_ROW.findall(page)), {f for f in _folders(package) if f in ROOMS}
    missing = [f"the table of rooms leaves out {room}/" for room in sorted(there - named)]
    return missing + [f"the table of rooms names {room}/, which is no room" for room in sorted(named - there)]


def satellite_imports(package: Package) -> list[str]:
    """Imports of a package beside mereo, lazy ones included, by modules that do without."""
    return [
        f"{i.place} imports {i.target}, which only {', '.join(SATELLITES[i.target])} may"
        for i in package
        if i.target in SATELLITES and not f"{i.source}.py".startswith(SATELLITES[i.target])
    ]


def misplaced_tests(tests: Path) -> list[str]:
    """Files of tests that lie neither in a folder named like a room or satellite, nor in one of ``TEST_FOLDERS``."""
    rooms = (*ROOMS, *(satellite.removeprefix("mereo_") for satellite in SATELLITES), *TEST_FOLDERS)
    files = sorted(file.relative_to(tests) for file in tests.rglob("*.py"))
    return [
        f"tests/{file} lies in no folder of tests: {', '.join(rooms)}"
        for file in files
        if file.parts[0] not in (*rooms, "conftest.py")
    ]


def over_budget(top: Path, budget: Mapping[str, tuple[int, int]]) -> list[str]:
    """Folders of ``top`` with more lines of Python, or more files, than they may have."""
    faults = list[str]()
    for folder, (most_lines, most_files) in budget.items():
        files = sorted((top / folder).rglob("*.py"))
        lines = sum(len(file.read_text("utf-8").splitlines()) for file in files)
        if lines > most_lines:
            faults.append(f"{folder} has {lines:,} lines, more than {most_lines:,}: cut as much as you add")
        if len(files) > most_files:
            faults.append(f"{folder} has {len(files)} files, more than {most_files}: merge two that are one idea")
    return faults


# --- rules of names ---------------------------------------------------------------------------------------------------


def banned_names(package: Package) -> list[str]:
    """Names that a module defines, locals and parameters included, which have a banned word as a part."""
    faults = list[str]()
    for module, tree in package.trees.items():
        for line, name in sorted(set(_defined_names(tree))):
            words = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower().split("_")
            if BANNED & set(words) or "at_hand" in name:
                faults.append(f"{module}.py:{line} defines {name}: call it by its noun (docs/glossary.md)")
    return faults


def _defined_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name
            case ast.alias(asname=str(name)):
                yield node.lineno, name


def long_signatures(package: Package) -> list[str]:
    """Public functions and methods with more parameters than ``MOST_PARAMETERS``, the object itself not counted."""
    return [
        f"{module}.py:{node.lineno} {node.name} has {count} parameters, more than {MOST_PARAMETERS}"
        for module, tree in package.trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_")
        if (count := _parameters(node.args)) > MOST_PARAMETERS
    ]


def _parameters(arguments: ast.arguments) -> int:
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))
