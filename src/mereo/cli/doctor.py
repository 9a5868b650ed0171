"""``mereo doctor``: what this machine offers and what is installed, for bug reports and for choosing settings."""

import importlib.metadata
import os
import platform
import re
import shlex
import sys
from collections.abc import Iterator

from mereo.io.cores import cores

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


def diagnose() -> None:
    """Print versions, device, threads, load, CPU features and extras, one fact a line."""
    for line in (*_platform(), *_packages(), *_device(), *_extras()):
        print(line)


def _row(name: str, value: object) -> str:
    return f"{name:<14} {value}"


def _platform() -> Iterator[str]:
    yield _row("mereo", _version("mereo") or "not installed")
    yield _row("python", f"{platform.python_version()} ({sys.executable})")
    yield _row("system", f"{platform.system()} {platform.machine()}")


def _packages() -> Iterator[str]:
    if not requirements(""):
        yield _row("packages", "unknown: mereo is not installed; run in its folder: pip install -e .")
    for requirement in requirements(""):
        name = _name(requirement)
        yield _row(name, _version(name) or f"missing: {install_command([requirement])}")


def requirements(extra: str) -> list[str]:
    """Requirements that pyproject.toml declares for an extra, such as ``tensorboard>=2.18``; ``""`` is mereo itself."""
    try:
        declared = importlib.metadata.requires("mereo") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found = []
    for entry in declared:
        requirement, _, marker = entry.partition(";")
        named = re.search(r"extra == ['\"](.+?)['\"]", marker)
        if (named.group(1) if named else "") == extra:
            found.append(requirement.strip())
    return found


def install_command(missing: list[str]) -> str:
    """Command line that installs these requirements for the running Python."""
    return shlex.join([sys.executable, "-m", "pip", "install", *missing])


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement)[0]


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _device() -> Iterator[str]:
    yield ""
    try:
        import torch
    except ModuleNotFoundError:
        yield _row("device", "cpu; objects are found by search, as the extra `network` is not installed")
        if hasattr(os, "getloadavg"):
            yield _row("load", describe_load(os.getloadavg()[0], os.cpu_count() or 1, cores()))
        return
    from mereo.models.device import cpu_features

    yield _row("torch", torch.__version__)
    if torch.cuda.is_available():
        free, total = torch.cuda.mem_get_info()
        memory = f"{free / 2**30:.1f} of {total / 2**30:.1f} GiB free"
        yield _row("device", f"cuda: {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}, {memory}")
    else:
        yield _row("device", "cpu")
    yield _row("threads", f"{torch.get_num_threads()} of {os.cpu_count()} cores")
    yield _row("wait policy", os.environ.get("OMP_WAIT_POLICY", "not set"))
    if hasattr(os, "getloadavg"):
        yield _row("load", describe_load(os.getloadavg()[0], os.cpu_count() or 1, torch.get_num_threads()))
    features = cpu_features()
    for name, present in features.items():
        yield _row(name, {True: "yes", False: "no", None: "unknown"}[present])
    yield _row("bfloat16", _bfloat16())


def describe_load(load: float, cores: int, threads: int) -> str:
    """Sentence on how busy the machine is, and what may help where it is.

    Args:
        load: processes that ran or wanted to, mean of the last minute.
        cores: of the machine.
        threads: that OpenMP would use.
    """
    found = f"{load:.1f} on {cores} cores"
    if load < cores / 2:
        return found
    return f"{found}, which is busy: {threads} threads wait for cores that others hold; fewer (--threads) may be faster"


def _bfloat16() -> str:
    from mereo.models.device import bfloat16_gain, pick_device, pick_precision

    device = pick_device()
    verdict = "does not pay here" if pick_precision("auto", device) is None else "pays here"
    return verdict if device.type == "cuda" else f"{verdict}: {bfloat16_gain():.1f} times float32"


def _extras() -> Iterator[str]:
    yield ""
    for extra, purpose in PURPOSES.items():
        missing = [r for r in requirements(extra) if _version(_name(r)) is None]
        if missing:
            yield _row(extra, f"missing, for {purpose}: {install_command(missing)}")
        else:
            yield _row(extra, f"installed, for {purpose}")
