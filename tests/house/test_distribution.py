"""How mereo reaches others: the image, the workflows, and the check that a tag is a version."""

import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

TOP = Path(__file__).parents[2]
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((TOP / ".github/workflows").glob("*.yml"))


def instructions() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile with what they are told, continued lines joined."""
    text = re.sub(r"^#.*\n", "", (TOP / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in text.splitlines() if line)]


def test_the_image_is_made_of_what_is_here_and_what_may_be_sent() -> None:
    sent = [line[1:] for line in (TOP / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    copied = [
        word for name, rest in instructions() if name == "COPY" and "--from" not in rest for word in rest.split()[:-1]
    ]
    assert sorted(copied) == sorted(sent)
    assert all((TOP / path).exists() for path in copied)
    needed = {PROJECT["readme"], *PROJECT["license-files"], "pyproject.toml", "src"}
    assert needed <= set(copied), "the wheel is built of these"


def test_the_image_runs_mereo_as_nobody_special() -> None:
    told = [name for name, _ in instructions()]
    last = dict(instructions())
    assert last["ENTRYPOINT"] == '["mereo"]'
    assert told.count("FROM") == 2 and last["FROM"].partition(" ")[0].startswith("python:3.")
    assert last["USER"].isdigit() and int(last["USER"]) > 0
    assert told.index("USER") > max(number for number, name in enumerate(told) if name == "RUN")
    (extras,) = re.findall(r'"\.\[([\w,]+)\]"', last.get("RUN", "") + "".join(rest for _, rest in instructions()))
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_what_there_is(path: Path) -> None:
    content: dict[Any, Any] = yaml.safe_load(path.read_text())
    assert content[True], "`on`, which YAML 1.1 takes for a truth value"
    assert content["permissions"] == {"contents": "read"}
    for job in content["jobs"].values():
        assert job["timeout-minutes"] <= 90
        assert set(job.get("needs", "").split()) <= content["jobs"].keys()
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert "uses" not in step or re.fullmatch(r"[\w-]+/[\w-]+@[\w./]+", step["uses"])
            for script in re.findall(r"(?<!\S)(?:python )?(\./\w+|\.ci/[\w.]+)", step.get("run", "")):
                assert (TOP / script).is_file(), script


@pytest.mark.parametrize(
    ("tag", "heading", "says"),
    [
        ("v1.2.3", "## 1.2.3 - 2026-12-01", ""),
        ("1.2.3", "## 1.2.3 - 2026-12-01", "the tag is 1.2.3 and pyproject.toml states 1.2.3: tag v1.2.3"),
        ("v1.3.0", "## 1.2.3 - 2026-12-01", "the tag is v1.3.0 and pyproject.toml states 1.2.3"),
        ("v1.2.3", "## 1.2.3 - unreleased", "CHANGELOG.md has no dated heading of 1.2.3"),
    ],
)
def test_a_tag_names_the_version(tag: str, heading: str, says: str) -> None:
    disagreement = runpy.run_path(str(TOP / ".ci/version.py"))["disagreement"]
    found = disagreement(tag, '[project]\nversion = "1.2.3"\n', f"# Changelog\n\n{heading}\n")
    assert found.startswith(says) and bool(found) == bool(says)
