"""Each example runs as a user would run it, in an empty folder."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from torch.distributed.run import get_args_parser

import mereo.__main__ as command_line
from mereo.cli.training import Generate, Train
from mereo.io.atomic_files import JsonObject

EXAMPLES = Path(__file__).parents[2] / "examples"
EXPECTED = {
    "desk_lamp.py": "mereo learn lamp/lamp.yaml --output learned",
    "loop.py": "wrote loop.webp: 9 frames",
    "query_points.py": "to the nearest surface",
    "reconstruct_cloud.py": "report.html",
    "sensors.py": "wrote",
    "shipped_weights.py": "wrote objects.png",
    "simulate_liver.py": "3 states of 98 nodes",
    "whole_frame.py": "wrote whole_frame.png",
    "wrong_answers.py": "wrote wrong_answers.png",
}
OPTIONS = {"loop.py": ("--fps", "1"), "shipped_weights.py": ("--weights", "rope", "--cells", "24")}
"""What keeps an example short."""

SHORT = ("desk_lamp.py", "query_points.py", "sensors.py")
"""The others take longer; what they call has tests of its own."""


def test_every_example_is_run() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in SHORT else pytest.mark.slow) for n in EXPECTED])
def test_example_runs(name: str, tmp_path: Path) -> None:
    if name == "simulate_liver.py":
        pytest.importorskip("mujoco", reason="mujoco is not installed: pip install 'mereo[simulation]'")
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *OPTIONS.get(name, ())],
        cwd=tmp_path,
        env={**os.environ, "PYTHONWARNINGS": "error"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    if "AssetUnavailable" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr[-2000:]
    assert EXPECTED[name] in done.stdout


FOLDER = EXAMPLES / "cluster"
SEPARATE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"
"""Without it nodes do not find each other after a restart."""


def commands(script: Path) -> list[list[str]]:
    text = re.sub(r"\\\n\s*", " ", script.read_text())
    text = re.sub(r"\$\w+", lambda name: "bunny" if name[0] == "$scene" else "2", text)
    lines = [shlex.split(line) for line in text.splitlines() if re.match(r"(srun |mereo )", line)]
    assert lines and not any("$" in word for words in lines for word in words), script
    return [words[1:] if words[0] == "srun" else words for words in lines]


def ran_by_torchrun(words: list[str]) -> tuple[Any, Train]:
    assert words[0] == "torchrun"
    options = get_args_parser().parse_args(words[1:])
    assert options.module and options.training_script == "mereo"
    command = command_line.parse(options.training_script_args)
    assert isinstance(command, Train)
    return options, command


def assert_started_well(options: Any, command: Train) -> None:
    """Processes share batches, meet by name, and are started again."""
    nodes, processes = int(options.nnodes), int(options.nproc_per_node)
    assert nodes == 2 and command.config.batch % (nodes * processes) == 0
    assert options.rdzv_backend == "c10d" and options.max_restarts > 0
    assert re.fullmatch(r"[a-z0-9.-]+:29400", options.rdzv_endpoint)


@pytest.mark.parametrize("script", sorted(FOLDER.glob("*.sbatch")), ids=lambda path: path.name)
def test_scripts_are_shell(script: Path) -> None:
    lines = script.read_text().splitlines()
    assert subprocess.run(["bash", "-n", script], capture_output=True, text=True).stderr == ""
    assert lines[0] == "#!/bin/bash" and "set -euo pipefail" in lines
    last = max(number for number, line in enumerate(lines) if line.startswith("#SBATCH"))
    assert all(line.startswith("#") for line in lines[:last]), "sbatch reads its options up to the first command"


def test_the_training_script_starts_what_it_should() -> None:
    (words,) = commands(FOLDER / "train.sbatch")
    options, command = ran_by_torchrun(words)
    assert_started_well(options, command)
    text = (FOLDER / "train.sbatch").read_text()
    assert f"--gpus-per-node={options.nproc_per_node}" in text and f"--nodes={options.nnodes}" in text
    assert "--ntasks-per-node=1" in text, "one torchrun on each machine"
    assert f"\nexport {SEPARATE}=1" in text


def test_the_generating_script_makes_all_parts() -> None:
    (words,) = commands(FOLDER / "generate.sbatch")
    command = command_line.parse(words[1:])
    assert isinstance(command, Generate) and command.resume
    part, parts = (int(number) for number in command.shard.split("/"))
    assert f"--array=0-{parts - 1}\n" in (FOLDER / "generate.sbatch").read_text() and part < parts


def test_kubernetes_starts_what_it_should() -> None:
    service, job = yaml.safe_load_all((FOLDER / "train-kubernetes.yaml").read_text())
    spec = job["spec"]
    template = job["spec"]["template"]
    pod = template["spec"]
    assert spec["completionMode"] == "Indexed" and spec["completions"] == spec["parallelism"]
    assert service["spec"]["selector"].items() <= template["metadata"]["labels"].items()
    assert pod["subdomain"] == service["metadata"]["name"]
    (container,) = pod["containers"]
    options, command = ran_by_torchrun([*container["command"], *container["args"]])
    assert_started_well(options, command)
    assert int(options.nnodes) == spec["completions"]
    assert int(options.nproc_per_node) == container["resources"]["limits"]["nvidia.com/gpu"]
    first, port = options.rdzv_endpoint.split(":")
    assert first == f"{job['metadata']['name']}-0.{service['metadata']['name']}", "an indexed pod's name"
    assert int(port) == service["spec"]["ports"][0]["port"]
    assert {"name": SEPARATE, "value": "1"} in container["env"]
    assert_on_the_volume(pod, command.dataset, command.output)


def test_kuberay_starts_what_it_should() -> None:
    job = yaml.safe_load((FOLDER / "generate-kuberay.yaml").read_text())
    words = shlex.split(job["spec"]["entrypoint"])
    at = words.index("--ray")
    assert words[at + 1] == "auto"
    command = command_line.parse([*words[1:at], *words[at + 2 :]])  # what --ray takes is tested with it
    assert isinstance(command, Generate) and command.resume
    cluster = job["spec"]["rayClusterSpec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        assert_on_the_volume(group["template"]["spec"], command.output)


def assert_on_the_volume(pod: JsonObject, *folders: Path) -> None:
    """These folders lie on a volume of the pod that outlives it."""
    (container,) = pod["containers"]
    claimed = {volume["name"] for volume in pod["volumes"] if "persistentVolumeClaim" in volume}
    kept = [mount["mountPath"] for mount in container["volumeMounts"] if mount["name"] in claimed]
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    assert all(any(folder.is_relative_to(place) for place in kept) for folder in folders)
