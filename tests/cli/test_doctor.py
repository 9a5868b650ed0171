"""The report on a machine: facts, and a command for everything that is missing."""

import sys
import tomllib
from pathlib import Path

import pytest
import torch

from mereo.cli import tools as doctor
from mereo.models import device


def test_report_names_versions_device_and_threads(capsys: pytest.CaptureFixture[str]) -> None:
    doctor.Doctor().run()
    report = capsys.readouterr().out
    facts = dict(line.split(maxsplit=1) for line in report.splitlines() if line)
    assert facts["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert facts["threads"].startswith(f"{torch.get_num_threads()} of ")
    assert {"device", "numpy", *doctor.PURPOSES} <= set(facts)


def test_every_extra_is_explained_and_every_explanation_has_one() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(project["optional-dependencies"]) == set(doctor.PURPOSES)
    assert all(doctor.requirements(extra) for extra in doctor.PURPOSES)
    assert any(requirement.startswith("torch") for requirement in doctor.requirements("network"))
    assert not any(requirement.startswith("torch") for requirement in doctor.requirements(""))
    assert not any("tensorboard" in requirement for requirement in doctor.requirements(""))


def test_missing_extra_comes_with_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    version = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "tensorboard" else version(name))
    doctor.Doctor().run()
    line = next(row for row in capsys.readouterr().out.splitlines() if row.startswith("track"))
    (requirement,) = doctor.requirements("track")
    assert "missing, for training curves" in line
    assert line.endswith(f"-m pip install '{requirement}'")


def test_probes_that_this_torch_lacks_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported", raising=False)

    def refuse() -> bool:
        raise RuntimeError

    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", refuse, raising=False)
    features = device.cpu_features()
    assert features["amx"] is None
    assert features["avx2"] is None
