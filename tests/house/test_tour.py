"""The tour: its outputs are those of its code, it is a page, and it runs (docs/tour.ipynb, docs/notebook.py)."""

import copy
import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

DOCS = Path(__file__).parents[2] / "docs"
MOST_BYTES = 400_000


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("notebook", DOCS / "notebook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tour(tool: ModuleType) -> dict[str, Any]:
    notebook: dict[str, Any] = tool.read()
    return notebook


def test_what_is_shown_is_of_the_code_as_it_is(tool: ModuleType, tour: dict[str, Any]) -> None:
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


def test_it_is_a_page(tool: ModuleType, tour: dict[str, Any]) -> None:
    page = tool.page(tour)
    assert page.startswith("# A tour") and page.count("data:image/png;base64,") == 6
    assert all(f"```python\n{code}\n```" in page for code in tool.code_of(tour))
    assert "<td>not found</td>" not in page


@pytest.mark.slow
def test_it_runs(tool: ModuleType, tour: dict[str, Any]) -> None:
    pytest.importorskip("nbclient")
    assert tool.shown(tool.executed(tour)) == tool.shown(tour)
