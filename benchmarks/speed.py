"""All that docs/speed.md says of this machine, in one command: idle and beside other work, against the aims.

    python benchmarks/speed.py [--repeats 7] [--beside 1] [--output out/speed]

`mereo bench --rival` of the bunny and of the preset `paper`, each in float32 and bfloat16, then `benchmarks/busy.py`:
about a quarter of an hour on two cores, which should have nothing else to do. Each table says how many cores were free
before it began. The last one holds the aims against what was found; the figures are also left as JSON.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SUBJECTS = {"bunny": ("--weights", "bunny"), "paper": ("--preset", "paper")}
PRECISIONS = ("float32", "bfloat16")

AIMS = {"40k queries": (0.3, 3.0), "labels": (1.0, 15.0), "surfaces": (1.0, 15.0)}
"""Most seconds of stages whose names begin so, and least times the straightforward way; two cores without AMX."""


def bench(subject: str, precision: str, options: argparse.Namespace) -> dict[str, Any]:
    """Figures of one run of `mereo bench`, which prints its tables itself."""
    file = options.output / f"{subject}-{precision}.json"
    command = [sys.executable, "-m", "mereo", "bench", *SUBJECTS[subject], "--rival", "--precision", precision]
    numbers = ["--repeats", str(options.repeats)]
    subprocess.run([*command, *numbers, "--output", str(file), "--force"], check=True)
    found: dict[str, Any] = json.loads(file.read_text("utf-8"))
    return found


def verdicts(name: str, found: dict[str, Any]) -> Iterator[str]:
    """Rows of the last table."""
    for stage in found["stages"]:
        for start, (most_s, least) in AIMS.items():
            if stage["name"].startswith(start):
                quick, ahead = stage["median"] <= most_s, stage["ratio"] >= least
                other = "" if stage["differing"] is None else f"{stage['differing']:.3%}"
                yield (
                    f"| {name}: {stage['name']} | {stage['median']:.2f} s | {most_s:g} s {_met(quick)} "
                    f"| {stage['ratio']:.1f} | {least:g} {_met(ahead)} | {other} |"
                )


def _met(holds: bool) -> str:
    return "met" if holds else "**missed**"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--beside", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("out/speed"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    rows: list[str] = []
    for subject in SUBJECTS:
        for precision in PRECISIONS:
            print(f"\n## {subject}, {precision}\n", flush=True)
            rows += verdicts(f"{subject}, {precision}", bench(subject, precision, options))
    print("\n## How OpenMP's threads wait\n", flush=True)
    policies = [sys.executable, str(Path(__file__).with_name("busy.py")), "--beside", str(options.beside)]
    subprocess.run(policies, check=False)  # it says itself where the limit is passed
    print(
        "\n## Aims\n\n| | found | aim | times the straightforward way | aim | other labels |\n|---|---|---|---|---|---|"
    )
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()
