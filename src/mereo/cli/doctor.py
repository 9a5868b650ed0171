"""The command ``mereo doctor``: what this machine offers and what is installed, for bug reports."""

import importlib.metadata
import os
import platform
import re
import shlex
import sys
from dataclasses import dataclass

PURPOSES: dict[str, str] = {
    "network": "weights: training them, and fits that start from them",
    "view": "the pages of `mereo view`",
    "rerun": "streams as Rerun recordings",
    "track": "training curves in TensorBoard",
    "plots": "curves of training runs, charts of experiments and of modes",
    "onnx": "networks for other runtimes",
    "cad": "3MF files",
    "medical": "NIfTI and NRRD volumes",
    "sensors": "ROS bags, EXR depth images and Zivid clouds",
    "simulation": "states from finite elements",
    "hub": "weights on a model hub",
    "storage": "datasets in S3 and what speaks it",
    "gcs": "datasets in Google Cloud Storage",
    "cluster": "generation, scoring, frames and learning on Ray clusters",
    "align": "ground truth from scans",
    "serve": "answers over HTTP",
    "docs": "the documentation as pages",
    "dev": "tests and checks",
}
"""Purpose of each extra of pyproject.toml; which packages it means is read from the installed metadata."""


@dataclass(frozen=True)
class Doctor:
    """Show versions, device, threads and extras, and how to install what is missing."""

    def run(self) -> None:
        """Print what is installed and what this machine offers, one fact a line."""
        facts = {
            "mereo": _version("mereo") or "not installed",
            "python": f"{platform.python_version()} ({sys.executable})",
            "system": f"{platform.system()} {platform.machine()}",
        }
        for requirement in requirements(""):
            facts[_name(requirement)] = _version(_name(requirement)) or f"missing: {_install([requirement])}"
        try:
            import torch
        except ModuleNotFoundError:
            facts["device"] = "cpu; objects are found by search, as the extra `network` is not installed"
        else:
            device = (
                f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}" if torch.cuda.is_available() else "cpu"
            )
            facts |= {"torch": torch.__version__, "device": device}
            facts["threads"] = f"{torch.get_num_threads()} of {os.cpu_count()} cores"
        for extra, purpose in PURPOSES.items():
            missing = [each for each in requirements(extra) if _version(_name(each)) is None]
            facts[extra] = f"missing, for {purpose}: {_install(missing)}" if missing else f"installed, for {purpose}"
        for name, fact in facts.items():
            print(f"{name:<14} {fact}")


def requirements(extra: str) -> list[str]:
    """Requirements that pyproject.toml declares for an extra, such as ``tensorboard>=2.18``; ``""`` is mereo itself."""
    try:
        declared = importlib.metadata.requires("mereo") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    entries = [entry.partition(";") for entry in declared]
    extras = [re.search(r"extra == ['\"](.+?)['\"]", marker) for _, _, marker in entries]
    return [
        entry[0].strip() for entry, named in zip(entries, extras, strict=True) if (named[1] if named else "") == extra
    ]


def _install(missing: list[str]) -> str:
    return shlex.join([sys.executable, "-m", "pip", "install", *missing])


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement)[0]


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
