"""The rules of the package's rooms, which read its sources alone: nothing is imported or run."""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from mereo.geometry.conventions import Names, Pair, WholeNumbers

MODULE_NAME = re.compile(r"\w+\.[\w.]*")


@dataclass(frozen=True)
class Import:
    """One place where a module names another one, or a library (``torch``), in an import statement or in a string."""

    source: str
    line: int
    target: str

    @property
    def place(self) -> str:
        return f"{self.source}.py:{self.line}"


@dataclass(frozen=True)
class Package:
    """The modules of a package below ``root``: the syntax of each, and all that they import."""

    root: Path
    trees: Mapping[str, ast.Module]
    imports: tuple[Import, ...]

    def __iter__(self) -> Iterator[Import]:
        return iter(self.imports)


def read_package(root: Path) -> Package:
    """Read every module below ``root``, the package's folder, whose name is the package's."""
    files = sorted(root.rglob("*.py"))
    trees = {f.relative_to(root).with_suffix("").as_posix(): ast.parse(f.read_text("utf-8"), str(f)) for f in files}
    modules = {".".join([root.name, *m.split("/")]).removesuffix(".__init__"): m for m in trees}
    imports = (found for module, tree in trees.items() for found in _imports(root.name, module, tree, modules))
    return Package(root, trees, tuple(dict.fromkeys(imports)))


def _imports(package: str, source: str, tree: ast.Module, modules: Mapping[str, str]) -> Iterator[Import]:
    for node in ast.walk(tree):
        names = list[str]()
        match node:
            case ast.Import(names=aliases):
                names = [alias.name for alias in aliases]
            case ast.ImportFrom(module=str(module), names=aliases, level=0):
                names = [f"{module}.{alias.name}" for alias in aliases]
            case ast.Call(func=ast.Name(id="import_module"), args=[ast.Constant(value=str(name)), *_]):
                names = [name]
            case ast.Constant(value=str(text)) if MODULE_NAME.fullmatch(text):
                names = _spelled(text.rstrip("."), package, modules)
        for name in names:
            library = name.partition(".")[0]
            target = _module_of(name, modules) if library == package else library
            yield Import(source, node.lineno, target)  # type: ignore[attr-defined]


def _spelled(name: str, package: str, modules: Mapping[str, str]) -> list[str]:
    """The module that a string names: for ``import_module``, in a table, or as the constant start of an f-string.

    Without the package's name, as ``"geometry.mesh"``, it must be a whole module: ``"training.csv"`` is a file. An
    f-string that goes on right after ``"mereo."`` can mean any room, so it counts as the root.
    """
    if name.partition(".")[0] != package:
        return [f"{package}.{name}"] if f"{package}.{name}" in modules else []
    return [name] if _module_of(name, modules) != "__init__" or name == package else []


def _module_of(name: str, modules: Mapping[str, str]) -> str:
    """The module that a dotted name lies in: itself, or the longest beginning that is one; else the root."""
    while name not in modules and name:
        name = name.rpartition(".")[0]
    return modules.get(name, "__init__")


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
    "locating",
    "results",
    "visualization",
    "api",
    "cli",
)
"""From the ground up: a room imports only from itself and from those before it."""

SUBROOMS = {"fitting": ("config", "problem", "modes", "search", "draws", "uncertainty", "registration", "tracking")}
"""Rooms whose sub-rooms, and modules beside them, have an order too: all of the room lies in one of these."""

ROOT_MODULES = ("__init__", "__main__")
"""The public names and the entry point, which may import every room."""

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

MAY_IMPORT = {"torch": ("models/", "cli/tools.py"), "matplotlib": ("io/extras.py",), **SATELLITES}
"""The same of libraries that most installations lack: asked for where they are used, with the extra's name."""

BUDGET = {
    "src/mereo": (304_226, 163),
    "src/mereo_learning": (45_670, 22),
    "src/mereo_objects": (40_005, 28),
    "src/mereo_serving": (10_580, 13),
    "src/mereo_viewer": (11_990, 5),
    "src/mereo_experiments": (11_185, 16),
    "tests": (294_240, 139),
}
"""Syntax nodes and files that a folder may have at most. Lines are free: fewer of them are not less to know."""

CHOICES = {"src/mereo/fitting": (217, 115), "src/mereo/locating": (30, 28)}
"""Decisions (``if`` statements and expressions) and numbers in module constants that a folder may have at most.

They choose among fits, and they only fall."""

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


def upward_imports(package: Package) -> list[str]:
    """Imports from a later room or sub-room, or from the root: lazy ones, for type checkers and in strings included."""
    inside = [i for i in package if i.target in package.trees and i.source not in ROOT_MODULES]
    upward = [i for i in inside if _height(i.target) > _height(i.source)]
    rules = {True: "a later room", False: "the root, which lies above all rooms"}
    return [f"{i.place} imports {i.target.replace('/', '.')}, {rules['/' in i.target]}" for i in upward]


def _height(module: str) -> Pair:
    """Place of the module's room in ``ROOMS``, then of its sub-room; what lies in none of them comes after all."""
    room, inside, *_ = *module.split("/"), ""
    return _place(room, ROOMS), _place(inside, SUBROOMS.get(room, ()))


def _place(name: str, order: Names) -> int:
    return order.index(name) if name in order else len(order)


def guarded_imports(package: Package) -> list[str]:
    """Imports of what only some may import, lazy ones included, by modules that do without."""
    return [
        f"{i.place} imports {i.target}, which only {', '.join(MAY_IMPORT[i.target])} may"
        for i in package
        if i.target in MAY_IMPORT and not f"{i.source}.py".startswith(MAY_IMPORT[i.target])
    ]


def cycles(package: Package) -> list[str]:
    """A circle of modules that name each other, if there is one: lazily, for type checkers and in strings included."""
    graph = {module: set[str]() for module in package.trees}
    for found in package:
        if found.target in graph and found.target != found.source:
            graph[found.source].add(found.target)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [" -> ".join(error.args[1][::-1])]  # now each imports the next
    return []


def heavy_libraries(modules: Iterable[str]) -> list[str]:
    """Libraries of ``HEAVY`` that importing these modules in a fresh interpreter loads."""
    code = f"import sys\nimport {', '.join(modules)}\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


# --- rules of files ---------------------------------------------------------------------------------------------------


def misplaced(package: Package) -> list[str]:
    """Modules that lie in no room and sub-room, and ``__init__.py`` of folders that are more than a docstring."""
    faults = list[str]()
    for module, tree in package.trees.items():
        room, inside, *_ = *module.split("/"), ""
        if room not in (*ROOMS, *ROOT_MODULES):
            faults.append(f"{module}.py lies in no room")
        elif room in SUBROOMS and inside not in (*SUBROOMS[room], "__init__"):
            faults.append(f"{module}.py lies in no sub-room")
        if module.endswith("/__init__") and (ast.get_docstring(tree) is None or len(tree.body) > 1):
            faults.append(f"{module}.py is not its docstring alone")
        if inside and f"{module.rpartition('/')[0]}/__init__" not in package.trees:
            faults.append(f"{module}.py lies in a folder without __init__.py")
    return faults


def misplaced_tests(tests: Path) -> list[str]:
    """Files of tests that lie neither in a folder named like a room or satellite, nor in one of ``TEST_FOLDERS``."""
    rooms = (*ROOMS, *(satellite.removeprefix("mereo_") for satellite in SATELLITES), *TEST_FOLDERS)
    files = sorted(file.relative_to(tests) for file in tests.rglob("*.py"))
    return [f"tests/{file}" for file in files if file.parts[0] not in (*rooms, "conftest.py")]


Count = Callable[[ast.Module], int]


def syntax_nodes(tree: ast.Module) -> int:
    """All nodes of a module's syntax."""
    return sum(1 for _ in ast.walk(tree))


def decisions(tree: ast.Module) -> int:
    """``if`` statements and conditional expressions."""
    return sum(isinstance(node, ast.If | ast.IfExp) for node in ast.walk(tree))


def constants(tree: ast.Module) -> int:
    """Numbers in what is assigned at the top of a module."""
    values = (node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value)
    literals = (node.value for value in values for node in ast.walk(value) if isinstance(node, ast.Constant))
    return sum(isinstance(value, int | float) and not isinstance(value, bool) for value in literals)


def over_budget(top: Path, budget: Mapping[str, WholeNumbers], units: Mapping[str, Count | None]) -> list[str]:
    """Folders of ``top`` whose Python has more of these units than the folder may have; None counts files."""
    faults = list[str]()
    for folder, most in budget.items():
        trees = [ast.parse(file.read_text("utf-8"), str(file)) for file in sorted((top / folder).rglob("*.py"))]
        for limit, (unit, count) in zip(most, units.items(), strict=True):
            total = len(trees) if count is None else sum(map(count, trees))
            if total > limit:
                faults.append(f"{folder} has {total:,} {unit}, more than {limit:,}: cut as much as you add")
    return faults


SIZE = {"syntax nodes": syntax_nodes, "files": None}
"""Units of ``BUDGET``."""

COMPLEXITY = {"decisions": decisions, "constants": constants}
"""Units of ``CHOICES``."""


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


def joined_assignments(package: Package) -> list[str]:
    """Lines that assign values of unlike kinds to several names, none of which needs another's: each has a line."""
    faults = list[str]()
    for module, tree in package.trees.items():
        for node in ast.walk(tree):
            match node:
                case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                    if _are_unlike(names, values):
                        faults.append(f"{module}.py:{node.lineno} assigns what is unlike: give each a line")
    return faults


def _are_unlike(names: list[ast.expr], values: list[ast.expr]) -> bool:
    """Whether names are given values of several kinds of expression, of which none reads a name before it."""
    if not all(isinstance(name, ast.Name) for name in names) or any(isinstance(each, ast.Starred) for each in values):
        return False
    operands = (getattr(each, "operand", each) for each in values)  # of a number below zero
    kinds = {ast.unparse(each.func) if isinstance(each, ast.Call) else type(each).__name__ for each in operands}
    earlier = [{ast.unparse(name) for name in names[:count]} for count in range(len(names))]
    read = [{each.id for each in ast.walk(value) if isinstance(each, ast.Name)} for value in values]
    return len(kinds) > 1 and not any(map(set.intersection, read, earlier))
