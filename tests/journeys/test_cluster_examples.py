"""Files for clusters: shells, torchrun and mereo read them as they stand, and names in them fit together.

`bash -n` parses the scripts; torchrun's own parser and mereo's read the commands, in scripts after the variables are
filled in as the scheduler would. Of YAML files the objects are checked where a slip would be found on the cluster only.
What fields an object may have is Kubernetes' to say.
"""

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from torch.distributed.run import get_args_parser

import mereo.__main__ as command_line
from mereo.cli.training import Generate, Train

FOLDER = Path(__file__).parents[2] / "examples" / "cluster"
SCRIPTS, FILES = sorted(FOLDER.glob("*.sbatch")), sorted(FOLDER.glob("*.yaml"))
FILLED = {
    "$data": "data/bunny",
    "$run": "runs/bunny",
    "$scene": "bunny",
    "$first": "node1",
    "$SLURM_JOB_NUM_NODES": "2",
    "$SLURM_JOB_ID": "17",
    "$SLURM_CPUS_PER_TASK": "32",
    "$SLURM_ARRAY_TASK_ID": "3",
}
"""What the variables of scripts stand for."""

SEPARATE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"
"""Without it nodes do not find each other after a restart."""


def commands(script: Path) -> list[list[str]]:
    text = re.sub(r"\\\n\s*", " ", script.read_text())
    for name, value in FILLED.items():
        text = re.sub(rf"{re.escape(name)}\b", value, text)
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


def objects() -> Iterator[tuple[Path, dict[str, Any]]]:
    for file in FILES:
        for item in yaml.safe_load_all(file.read_text()):
            yield file, item


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_shell(script: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("there is no bash")
    lines = script.read_text().splitlines()
    assert subprocess.run([bash, "-n", script], capture_output=True, text=True).stderr == ""
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
    (_, service), (_, job) = (item for item in objects() if item[0].name == "train-kubernetes.yaml")
    assert (service["apiVersion"], service["kind"]) == ("v1", "Service") and service["spec"]["clusterIP"] == "None"
    assert (job["apiVersion"], job["kind"]) == ("batch/v1", "Job")
    spec, template = job["spec"], job["spec"]["template"]
    pod = template["spec"]
    assert spec["completionMode"] == "Indexed" and spec["completions"] == spec["parallelism"]
    assert service["spec"]["selector"].items() <= template["metadata"]["labels"].items()
    assert pod["subdomain"] == service["metadata"]["name"] and pod["restartPolicy"] in ("Never", "OnFailure")
    (container,) = pod["containers"]
    options, command = ran_by_torchrun([*container["command"], *container["args"]])
    assert_started_well(options, command)
    assert int(options.nnodes) == spec["completions"]
    assert int(options.nproc_per_node) == container["resources"]["limits"]["nvidia.com/gpu"]
    first, port = options.rdzv_endpoint.split(":")
    assert first == f"{job['metadata']['name']}-0.{service['metadata']['name']}", "an indexed pod's name"
    assert int(port) == service["spec"]["ports"][0]["port"]
    assert all(isinstance(item["value"], str) for item in container["env"])
    assert {"name": SEPARATE, "value": "1"} in container["env"]
    assert_on_the_volume(pod, command.dataset, command.output)


def test_kuberay_starts_what_it_should() -> None:
    ((_, job),) = (item for item in objects() if item[0].name == "generate-kuberay.yaml")
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    words = shlex.split(job["spec"]["entrypoint"])
    at = words.index("--ray")
    assert words[at + 1] == "auto"
    command = command_line.parse([*words[1:at], *words[at + 2 :]])  # what --ray takes is tested with it
    assert isinstance(command, Generate) and command.resume
    cluster = job["spec"]["rayClusterSpec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        assert_on_the_volume(group["template"]["spec"], command.output)
    (workers,) = cluster["workerGroupSpecs"]
    assert workers["minReplicas"] <= workers["replicas"] <= workers["maxReplicas"]


def assert_on_the_volume(pod: dict[str, Any], *folders: Path) -> None:
    """These folders lie on a volume of the pod that outlives it."""
    (container,) = pod["containers"]
    claimed = {volume["name"] for volume in pod["volumes"] if "persistentVolumeClaim" in volume}
    kept = [mount["mountPath"] for mount in container["volumeMounts"] if mount["name"] in claimed]
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    assert all(any(folder.is_relative_to(place) for place in kept) for folder in folders)
