"""A package's imports, read from its sources alone: nothing is imported or run.

A module is called by its file below the package's folder, without ``.py``: ``geometry/mesh``, ``io/writers/__init__``.
"""

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

MODULE_NAME = re.compile(r"\w+\.[\w.]*")


@dataclass(frozen=True)
class Import:
    """One place where a module names another one, in an import statement or in a string.

    Attributes:
        source: the module that imports.
        line: where, counted from 1.
        target: the module of the package that is imported, or a library's name (``torch``).
        at_start: it is a statement of the module itself, which importing it executes.
    """

    source: str
    line: int
    target: str
    at_start: bool

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
            yield Import(source, node.lineno, target, node in tree.body)  # type: ignore[attr-defined]


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
