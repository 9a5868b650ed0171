"""Under torchrun, process 0 failing alone ends all processes, with its sentence and no other."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from toy_data import write_toy_dataset

FAILS = """
import errno, os, sys
from pathlib import Path
import mereo.__main__ as command_line
from mereo.training import trainer
from mereo.io.atomic_files import atomic_file
def full(run_dir, checkpoint):
    with atomic_file(run_dir / "checkpoint.safetensors"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
def refused(self, step):
    raise ValueError("the table is odd")
{patch}
trainer.train.__kwdefaults__["checkpoint_every_s"] = 0.0
code = command_line.main(sys.argv[1:])
print(f"rank {{os.environ['RANK']}} ends with {{code}}", flush=True)
sys.exit(code)
"""

TRAIN = (
    "train data --output run --preset tiny --precision float32 --compile off --batch 8 --queries 48 --epochs 2 "
    "--network.points 64 --network.width 48 --network.neighbors 8 --holdout 0"
)


def run_ranks(folder: Path, patch: str) -> "subprocess.CompletedProcess[str]":
    """Two processes that train, process 0 with a patch."""
    (folder / "fails.py").write_text(FAILS.format(patch=patch))
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    return subprocess.run(
        [*launcher, "fails.py", *TRAIN.split()],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.slow
def test_a_full_disk_at_a_checkpoint_ends_all_with_one_sentence(tmp_path: Path) -> None:
    write_toy_dataset(tmp_path / "data", examples=32)
    done = run_ranks(tmp_path, "trainer.save_checkpoint = full")
    said = [line for line in done.stderr.splitlines() if line.startswith("mereo: ")]
    assert done.returncode != 0 and len(said) == 1, done.stderr
    assert said[0].startswith("mereo: error: the disk is full while writing run/checkpoint.safetensors"), said
    assert "Traceback" not in done.stderr.partition("torch/distributed")[0], done.stderr
    assert not list((tmp_path / "run").glob(".*"))


@pytest.mark.slow
def test_a_refused_folder_ends_all_with_one_sentence(tmp_path: Path) -> None:
    write_toy_dataset(tmp_path / "data", examples=32)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("precious")
    done = run_ranks(tmp_path, "")
    said = [line for line in done.stderr.splitlines() if line.startswith("mereo: ")]
    assert done.returncode != 0 and len(said) == 1 and "is not empty and holds no config.json" in said[0], done.stderr
