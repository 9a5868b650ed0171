"""The pages of the documentation that nobody writes: MkDocs calls the ``on_*`` functions while it builds.

The home page is README.md, and CONTRIBUTING.md, CHANGELOG.md and LICENSE are pages too; so that links between them and
the rest work in the repository as well as here, their targets are rewritten. ``src/mereo`` gives a page for each of its
folders with all that is public there, ``src/mereo_learning`` one, and each model card one. The tour is an executed
notebook, ``tour.ipynb``.
"""

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "mereo"
LEARNING = ROOT / "src" / "mereo_learning"

COPIES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "LICENSE": "licence.md",
}
"""Files of the repository's root, and the pages that they become."""

TOUR = "tour.md"

ASSET = re.compile(r"""<(?:script|img|link|iframe|source)\b[^>]*?\b(?:src|href)=["']?(?:https?:)?//[^>]*>""")
"""What a browser would fetch from another host. Links to follow are not meant, nor the page's own address."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The navigation: what mkdocs.yml lists, then what lies in folders."""
    notes = sorted(path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs" / "design").glob("*.md"))
    config.nav = [
        *(config.nav or []),
        {"API by room": ["api/index.md", *_rooms(SOURCE), _page_of(LEARNING)]},
        {"Decisions": notes},
        {"Model cards": [f"models/{card.name}" for card in _cards()]},
        {"Project": ["contributing.md", "changelog.md", "licence.md"]},
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """All pages that are made here join those of docs/."""
    for name, text in _pages():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with links to the tour's page; the repository shows the notebook itself, which the tour offers."""
    return markdown if page.file.src_uri == TOUR else markdown.replace("](tour.ipynb)", f"]({TOUR})")


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The page as it is; what loads anything from another host is an error."""
    if foreign := ASSET.search(output):
        raise PluginError(f"{page.file.src_uri} loads {foreign.group()}: keep a copy in docs/, or leave it out")
    return output


def _pages() -> Iterator[tuple[str, str]]:
    """Name and text of every page."""
    for source, target in COPIES.items():
        text = (ROOT / source).read_text()
        yield target, f"# Licence\n\n```text\n{text}```\n" if source == "LICENSE" else _from_root(text)
    yield "api/index.md", _public_names()
    for package in (*_packages(SOURCE), LEARNING):
        yield _page_of(package), _reference(package)
    for card in _cards():
        yield f"models/{card.name}", card.read_text()
    yield TOUR, _tour()


def _tour() -> str:
    """The notebook as a page; ``notebook.py`` beside this file makes it, and MkDocs imports no neighbours of hooks."""
    spec = importlib.util.spec_from_file_location("notebook", Path(__file__).with_name("notebook.py"))
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    text: str = tool.page(tool.read())
    return text


def _from_root(text: str) -> str:
    """A file of the repository's root with links as they are from docs/."""
    for source, target in COPIES.items():
        text = text.replace(f"]({source}", f"]({target}")
    return text.replace("](docs/", "](")


def _cards() -> list[Path]:
    return sorted(ROOT.glob("weights/src/mereo_weights/*.md"))


def _packages(folder: Path) -> Iterator[Path]:
    """Every folder of code below this one, a room before what lies in it, without what is private."""
    for init in sorted(folder.glob("[!_]*/__init__.py")):
        yield init.parent
        yield from _packages(init.parent)


def _rooms(folder: Path) -> list[Any]:
    """The navigation of the folders below this one, in the order of architecture.md; a room of rooms is a section."""
    order = re.findall(r"^\| `(\w+)/` \|", (ROOT / "docs" / "architecture.md").read_text(), re.MULTILINE)
    found: list[Any] = []
    rooms = (package for package in _packages(folder) if package.parent == folder)
    for package in sorted(rooms, key=lambda room: order.index(room.name) if room.name in order else len(order)):
        inner = _rooms(package)
        found.append({package.name: [_page_of(package), *inner]} if inner else _page_of(package))
    return found


def _page_of(package: Path) -> str:
    inner = any(True for _ in _packages(package))
    return f"api/{'/'.join(_names_of(package))}{'/index' if inner else ''}.md"


def _names_of(package: Path) -> tuple[str, ...]:
    return package.relative_to(SOURCE if SOURCE in package.parents else SOURCE.parent).parts


def _reference(package: Path) -> str:
    """A room's page: its own docstring, then its modules one by one."""
    path = package.relative_to(SOURCE.parent)
    docstring = ast.get_docstring(ast.parse((package / "__init__.py").read_text())) or ""
    modules = [".".join((*path.parts, module.stem)) for module in sorted(package.glob("[!_]*.py"))]
    return (
        "\n\n".join([f"# {'.'.join(_names_of(package))}", docstring, *(f"::: {module}" for module in modules)]) + "\n"
    )


def _public_names() -> str:
    """What ``import mereo`` gives, each name with a link to where it is defined."""
    tree = ast.parse((SOURCE / "__init__.py").read_text())
    rows = [
        f"| `mereo.{alias.asname}` | [`{node.module}.{alias.name}`][{node.module}.{alias.name}] |"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mereo")
        for alias in node.names
        if alias.asname
    ]
    table = "\n".join(["| name | defined as |", "|---|---|", *rows])
    examples = "[Python by example](../python.md) shows how they are used."
    return f"# mereo\n\n{examples}\n\n{ast.get_docstring(tree)}\n\n{table}\n"
