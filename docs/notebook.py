"""Run docs/tour.ipynb from its start and keep what its cells show: ``python docs/notebook.py`` after a change of it.

The notebook is shown as a page of the documentation (``docs/pages.py``). It holds a digest of the code that its outputs
are of, so that a changed cell with old outputs is found without running anything.
"""

import hashlib
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

TOUR = Path(__file__).with_name("tour.ipynb")

LONGEST_S = 300
"""Seconds that one cell may take."""

Notebook = dict[str, Any]


def read(path: Path = TOUR) -> Notebook:
    """Notebook of a file, as JSON values."""
    notebook: Notebook = json.loads(path.read_text("utf-8"))
    return notebook


def code_of(notebook: Notebook) -> list[str]:
    """Text of each code cell."""
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def digest(notebook: Notebook) -> str:
    """SHA-256 of all code, by which outputs are known to belong to it."""
    return hashlib.sha256(json.dumps(code_of(notebook)).encode()).hexdigest()


def executed(notebook: Notebook) -> Notebook:
    """The same notebook with what its cells show when they run in a fresh kernel and an empty folder.

    Raises ``nbclient.exceptions.CellExecutionError`` with the cell and its traceback where one fails.
    """
    import nbclient
    import nbformat

    made = nbformat.reads(json.dumps(notebook), as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(
            made,
            timeout=LONGEST_S,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        # tqdm, of which torch makes use where it is installed, asks for widgets
        client.execute(env={**os.environ, "PYTHONWARNINGS": "ignore:IProgress not found"})
    result: Notebook = json.loads(nbformat.writes(made))
    # what a kernel says of itself differs from one machine to the next
    result["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "mereo": {"code": digest(result)},
    }
    return result


def shown(notebook: Notebook) -> list[str]:
    """What the cells print and show as text, without what differs from run to run and where meshes are missing.

    Numbers are #, with one space however they are aligned, and so is the way of a fit, which without the scene's mesh
    is by modes alone; warnings are left out.
    """
    told = []
    for cell in notebook["cells"]:
        for output in cell.get("outputs", []):
            if output.get("name") == "stderr":
                continue
            text = output.get("text") or output.get("data", {}).get("text/plain") or [output["output_type"]]
            told.append(re.sub(r" +", " ", re.sub(r"[\d.]+|modes|draws", "#", "".join(text))))
    return told


# --- as a page --------------------------------------------------------------------------------------------------------


def page(notebook: Notebook) -> str:
    """Notebook as Markdown with HTML: text, code, and what the code has shown."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [_output(output) for output in cell["outputs"]]
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "text/html" in data:
        return "".join(data["text/html"])
    text = "".join(output.get("text") or data.get("text/plain") or output.get("traceback", []))
    return f"```text\n{text.rstrip()}\n```"


def main() -> None:
    """Run the notebook and write it back with its outputs."""
    made = executed(read())
    TOUR.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"{TOUR.name}: {len(code_of(made))} cells, {TOUR.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
