"""A package's imports, read from its sources alone: nothing is imported or run.

A module is called by its file below the package's folder, without ``.py``: ``geometry/mesh``, ``io/writers/__init__``.
"""

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

TYPES_ONLY = ("TYPE_CHECKING", "typing.TYPE_CHECKING")
"""Conditions that hold for type checkers and never when a program runs."""

MODULE_NAME = re.compile(r"\w+\.[\w.]*")


@dataclass(frozen=True)
class Import:
    """One place where a module names another one, in an import statement or in a string.

    Attributes:
        source: the module that imports.
        line: where, counted from 1.
        target: the module of the package that is imported, or a library's name (``torch``).
        at_start: importing ``source`` executes it: it is neither in a function, nor for type checkers only, nor a
            string.
    """

    source: str
    line: int
    target: str
    at_start: bool

    @property
    def edge(self) -> str:
        """The two modules without the line, which every change above it would move."""
        return f"{self.source} -> {self.target}"

    @property
    def place(self) -> str:
        return f"{self.source}.py:{self.line}"


@dataclass(frozen=True)
class Package:
    """The modules of a package.

    Attributes:
        root: its folder.
        trees: the syntax of each module.
        imports: all that they import, by module.
    """

    root: Path
    trees: Mapping[str, ast.Module]
    imports: Mapping[str, tuple[Import, ...]]

    def __iter__(self) -> Iterator[Import]:
        for imports in self.imports.values():
            yield from imports

    def needs(self, module: str) -> list[str]:
        """What importing a module imports at once: other modules of the package, and libraries."""
        return [i.target for i in self.imports.get(module, ()) if i.at_start and i.target != module]


def read_package(root: Path) -> Package:
    """Read every module below ``root``, the package's folder, whose name is the package's."""
    files = sorted(root.rglob("*.py"))
    trees = {f.relative_to(root).with_suffix("").as_posix(): ast.parse(f.read_text("utf-8"), str(f)) for f in files}
    modules = {_dotted(root.name, module): module for module in trees}
    imports = {m: tuple(dict.fromkeys(_imports(root.name, m, tree, modules))) for m, tree in trees.items()}
    return Package(root, trees, imports)


def _dotted(package: str, module: str) -> str:
    """``mereo.io.writers`` for ``io/writers/__init__``."""
    return ".".join([package, *module.split("/")]).removesuffix(".__init__")


def _imports(package: str, source: str, tree: ast.Module, modules: Mapping[str, str]) -> Iterator[Import]:
    folder = [package, *source.split("/")[:-1]]
    for node, at_start in _nodes(tree):
        for name in _imported(node, folder):
            library = name.partition(".")[0]
            target = _module_of(name, modules) if library == package else library
            yield Import(source, node.lineno, target, at_start)
        for target in _spelled(node, package, modules):
            yield Import(source, node.lineno, target, at_start=False)


def _nodes(node: ast.AST, at_start: bool = True) -> Iterator[tuple[ast.stmt | ast.expr, bool]]:
    """All statements and expressions below a node, with whether importing the module executes them."""
    if isinstance(node, ast.stmt | ast.expr):
        yield node, at_start
    inside = at_start and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
    for_types = node.body if isinstance(node, ast.If) and ast.unparse(node.test) in TYPES_ONLY else []
    for child in ast.iter_child_nodes(node):
        yield from _nodes(child, inside and child not in for_types)


def _imported(node: ast.AST, folder: list[str]) -> list[str]:
    """Dotted names of what a statement, or a call of ``import_module`` with a literal, imports."""
    match node:
        case ast.Import(names=names):
            return [alias.name for alias in names]
        case ast.ImportFrom(module=module, names=names, level=level):
            base = [*folder[: len(folder) - level + 1], *([module] if module else [])] if level else [module or ""]
            return [".".join([*base, alias.name]) for alias in names]
        case ast.Call(func=ast.Name(id=called) | ast.Attribute(attr=called), args=[ast.Constant(value=str(name)), *_]):
            return [name] if called in ("import_module", "__import__") else []
    return []


def _spelled(node: ast.AST, package: str, modules: Mapping[str, str]) -> list[str]:
    """The module that a string names: for ``import_module``, in a table, or as the constant start of an f-string.

    Without the package's name, as ``"geometry.mesh"``, it must be a whole module: ``"training.csv"`` is a file. An
    f-string that goes on right after ``"mereo."`` can mean any room, so it counts as the root.
    """
    if not (isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE_NAME.fullmatch(node.value)):
        return []
    name = node.value.rstrip(".")
    if name.partition(".")[0] != package:
        return [modules[f"{package}.{name}"]] if f"{package}.{name}" in modules else []
    target = _module_of(name, modules)
    return [target] if target != "__init__" or name == package else []


def _module_of(name: str, modules: Mapping[str, str]) -> str:
    """The module that a dotted name lies in: itself, or the longest beginning that is one; else the root."""
    while name not in modules and name:
        name = name.rpartition(".")[0]
    return modules.get(name, "__init__")
