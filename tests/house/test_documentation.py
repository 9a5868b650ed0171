"""The documentation: every link leads somewhere, every command and import exists, the tour is of the code as it is."""

import ast
import copy
import importlib
import importlib.util
import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from page_blocks import FENCE, ROOT, blocks

from mereo.__main__ import parse

EXPERIMENTS = ROOT / "docs" / "experiments.md"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("weights/**/*.md")])
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
RELEASED = [page for page in PAGES if EXPERIMENTS not in (page, page.parent.with_suffix(".md"))]
"""Pages about the code as it is; an experiment is about the code of its commit."""
INITS = sorted([*ROOT.glob("src/mereo/*/__init__.py"), *ROOT.glob("src/mereo_*/__init__.py")])
ROOMS = "|".join(init.parent.name for init in INITS)


def prose(page: Path) -> str:
    """A page without its code blocks and code spans, where brackets mean something else."""
    return re.sub(r"``?[^`\n]+``?", "``", FENCE.sub("", page.read_text()))


def anchors(page: Path) -> set[str]:
    """Places in a page that a link may name: explicit ones, and headings that GitHub and MkDocs call the same."""
    text = FENCE.sub("", page.read_text())
    explicit = set(re.findall(r'<a id="([^"]+)"></a>', text))
    headings = [re.sub(r"<[^>]+>|`", "", title).strip() for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)]
    words = [re.sub(r"[^\w\s-]", "", heading).lower() for heading in headings]
    return explicit | {slug for word in words if (slug := word.replace(" ", "-")) == re.sub(r"[-\s]+", "-", word)}


def broken(page: Path) -> list[str]:
    """The links of a page that lead nowhere."""
    found = []
    for target in LINK.findall(prose(page)):
        if re.match(r"https?://|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            found.append(target)
    return found


def commands(page: Path) -> Iterator[str]:
    """The calls of ``mereo`` in a page's shell blocks, each as one line."""
    for code in blocks(page, "sh", "bash"):
        for line in re.sub(r"\\\n\s*", " ", code).splitlines():
            if line.startswith("mereo ") and "..." not in line:
                yield line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text('# A -- b\n\n## <a id="x"></a>C `d`\n\n[](#x) [](#c-d) [](#a----b) [](no.md) [](#y) `[](z)`\n')
    assert broken(page) == ["#a----b", "no.md", "#y"]  # the first: MkDocs would write a-b


def test_every_experiment_has_the_anchor_of_its_number() -> None:
    rows = re.findall(
        r'^\| <a id="entry-(\w+)"></a>\[\1\]\(experiments/(\w+)\.md\) \|', EXPERIMENTS.read_text(), re.MULTILINE
    )
    files = {page.stem: page.read_text() for page in EXPERIMENTS.with_suffix("").glob("*.md")}
    assert len(rows) == len(files) > 60
    for number, name in rows:
        assert files[name].startswith(f"# {number}. "), number


def test_every_entry_that_is_mentioned_exists() -> None:
    entries = {anchor.removeprefix("entry-") for anchor in anchors(EXPERIMENTS)}
    for page in (*PAGES, *ROOT.glob("src/**/*.py"), *ROOT.glob("benchmarks/*.py")):
        mentioned = re.findall(r"\b[Ee]ntr(?:y|ies) (\d+[a-z]?)\b", page.read_text())
        assert set(mentioned) <= entries, page


@pytest.mark.parametrize("page", [p for p in RELEASED if any(commands(p))], ids=lambda page: page.name)
def test_commands_parse(page: Path, working_folder: Path) -> None:
    for folder in ("result", "out/bunny"):  # which an earlier line of a page has made
        (working_folder / folder).mkdir(parents=True)
        (working_folder / folder / "config.json").write_text('{"inputs": ["frame.ply"], "weights": "bunny"}')
    for line in commands(page):
        try:
            parse(shlex.split(line, comments=True)[1:])
        except (ValueError, SystemExit) as error:
            if not (isinstance(error, SystemExit) and not error.code):  # printing the completion ends with none
                pytest.fail(f"{line}\n{error}")


def test_imports_in_python_blocks_exist() -> None:
    for page in RELEASED:
        for code in blocks(page, "python"):
            for node in ast.walk(ast.parse(code)):
                if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("mereo"):
                    module = importlib.import_module(node.module)
                    assert all(hasattr(module, alias.name) for alias in node.names), f"{page}: {ast.unparse(node)}"


def exists(name: str) -> bool:
    """Whether this is a module of mereo or a definition in one, as ``models.decoder.LocalAttention`` is."""
    parts = name.split(".")
    parts = parts if parts[0].startswith("mereo_") else ["mereo", *parts]
    depth = next(n for n in range(len(parts), 0, -1) if is_module(ROOT.joinpath("src", *parts[:n])))
    if depth == len(parts):
        return True  # not imported: some modules need an extra
    found = importlib.import_module(".".join(parts[:depth]))
    for part in parts[depth:]:
        if not hasattr(found, part) and part not in getattr(found, "__annotations__", {}):
            return False
        found = getattr(found, part, None)
    return True


def is_module(path: Path) -> bool:
    return path.is_dir() or path.with_suffix(".py").is_file()


def test_modules_and_definitions_that_pages_name_exist() -> None:
    assert exists("synthesis.examples.LabelledPoints.rest")  # a field without a default
    assert not exists("synthesis.examples.LabelledPoints.nothing")
    assert not exists("synthesis.nothing")
    for page in RELEASED:
        named = re.findall(rf"`(?:mereo\.)?((?:{ROOMS})(?:\.\w+)+)[(`]", page.read_text())
        assert [name for name in named if not exists(name)] == [], page
        files = re.findall(rf"`(?:src/mereo/)?((?:{ROOMS})/[\w./]+)`", page.read_text())
        assert [name for name in files if not (ROOT / "src" / "mereo" / name).exists()] == [], page


def test_the_glossary_names_what_exists_and_each_term_once() -> None:
    """Options by the fields that they are made of, other names by a definition anywhere in the packages."""
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]*) \|$", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE)
    terms = [term for term, _ in rows if term not in ("term", "---")]
    assert len(terms) > 60 and len(set(terms)) == len(terms)
    source = "\n".join(path.read_text() for path in ROOT.glob("src/**/*.py"))
    defined = set(re.findall(r"^ *(?:class|def) (\w+)|^ *(\w+)(?:: | = )", source, re.MULTILINE))
    known = {name for pair in defined for name in pair}
    named = {name for _, names in rows for name in re.findall(r"`([^`]+)`", names)}
    assert {name for name in named if name.removeprefix("--").replace("-", "_") not in known} == set()


def test_readme_is_one_screen_and_pages_of_use_and_decisions_are_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 80
    use = (ROOT / "mkdocs.yml").read_text().partition("- Use:")[2].partition("- Reference:")[0]
    pages = [ROOT / "README.md", *(DOCS / name for name in re.findall(r": ((?!tour)\S+)", use))]
    assert sum(len(page.read_text().split()) for page in pages) <= 9000
    for page in ROOT.glob("docs/design/*.md"):
        assert len(page.read_text().splitlines()) <= 40, page


def test_citation_and_weights_are_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project, weights = (tomllib.loads((ROOT / f"{at}pyproject.toml").read_text())["project"] for at in ("", "weights/"))
    assert citation["title"] == project["name"]
    assert all(citation[key] == project[key] == weights[key] for key in ("version", "license", "authors"))
    assert f"mereo-weights=={project['version']}" in project["optional-dependencies"]["network"]


def test_every_library_has_a_lowest_version() -> None:
    lowest = runpy.run_path(str(ROOT / ".ci" / "lowest.py"))
    constraints = lowest["constraints"](*((ROOT / name).read_text() for name in ("pyproject.toml", "constraints.txt")))
    assert {"torch==2.8", "numpy==1.26"} <= set(constraints)
    assert any(line.startswith("ruff==") for line in constraints)  # the tools are pinned as ever
    with pytest.raises(ValueError, match="'ray<3' has no lower bound; write the oldest version that works as >="):
        lowest["lowest"]("ray<3")


# --- the tour ---------------------------------------------------------------------------------------------------------


DOCS = ROOT / "docs"
MOST_BYTES = 400_000


@pytest.fixture(scope="module")
def tool() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(DOCS / "notebook.py")))


@pytest.fixture(scope="module")
def tour(tool: SimpleNamespace) -> dict[str, Any]:
    return tool.read()


def test_what_is_shown_is_of_the_code_as_it_is(tool: SimpleNamespace, tour: dict[str, Any]) -> None:
    assert tour["metadata"]["mereo"]["code"] == tool.digest(tour), "a cell has changed: run python docs/notebook.py"
    cells = [cell for cell in tour["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    for cell, code in zip(cells, tool.code_of(tour), strict=True):
        compile(code, "tour.ipynb", "exec")
        assert cell["outputs"] and all(output["output_type"] != "error" for output in cell["outputs"])
        assert all(output.get("name") != "stderr" for output in cell["outputs"])
    changed = copy.deepcopy(tour)
    changed["cells"][1]["source"].append("\n# another line")
    assert tool.digest(changed) != tool.digest(tour)


def test_it_is_small_and_names_nobodys_folders() -> None:
    text = (DOCS / "tour.ipynb").read_text("utf-8")
    assert len(text.encode()) < MOST_BYTES
    assert not re.search(r"/(?:home|root|tmp|work|Users)/", re.sub(r"base64,[^\\\"]+", "", text))


def test_it_is_a_page(tool: SimpleNamespace, tour: dict[str, Any]) -> None:
    page = tool.page(tour)
    assert page.startswith("# A tour") and page.count("data:image/png;base64,") == 6
    assert all(f"```python\n{code}\n```" in page for code in tool.code_of(tour))
    assert "<td>not found</td>" not in page


@pytest.mark.slow
def test_it_runs(tool: SimpleNamespace, tour: dict[str, Any]) -> None:
    pytest.importorskip("nbclient")
    assert tool.shown(tool.executed(tour)) == tool.shown(tour)
