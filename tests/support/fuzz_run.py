"""Damage one kind of file again and again, in its own process: ``python tests/support/fuzz_run.py depth.png``.

Prints a line of JSON for each kind of fault, then one with the counts. Input i of a seed is the same everywhere.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz_mutations import damaged
from fuzz_rule import Fault, fault_of
from fuzz_targets import TARGETS, Target


@dataclass(frozen=True)
class Case:
    """One damaged input: its number, its content, whether it was taken, and what broke the rule, if anything did."""

    number: int
    content: bytes
    taken: bool
    fault: Fault | None


def cases(target: Target, folder: Path, seed: int, first: int = 0) -> Iterator[Case]:
    """Damaged inputs without end; files that are written lie in ``folder``."""
    path = folder / target.name
    path.parent.mkdir(parents=True, exist_ok=True)
    target.write(path)
    whole, number = path.read_bytes(), first
    names = tuple(p.name for p in (path.parent, folder)) if target.folder else ()
    _, fault = fault_of(target.read, path, names)
    assert fault is None, f"{target.name} breaks the rule before it is damaged: {fault}"
    while True:
        content = damaged(whole, Random(f"{seed}/{target.name}/{number}"))
        path.write_bytes(content)
        yield Case(number, content, *fault_of(target.read, path, names))
        number += 1


def main() -> None:
    """Try the targets one after the other; exit code 1 where any broke the rule."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="+", choices=TARGETS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--count", type=int, default=1, help="inputs of each target")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most, of each target")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()), help="where inputs with faults go")
    options = parser.parse_args()
    kinds = sum(_try(name, options) for name in options.targets)
    sys.exit(1 if kinds else 0)


def _try(name: str, options: argparse.Namespace) -> int:
    """Number of kinds of faults of one target, which are printed."""
    end, counts, kinds = float("inf"), Counter[str](), set[str]()
    with tempfile.TemporaryDirectory(dir=options.keep) as folder:  # it stays where a library ends the process
        for case in cases(TARGETS[name], Path(folder), options.seed, options.first):
            end = min(end, time.monotonic() + options.seconds)  # from the first on: it may import much
            counts["taken" if case.taken else "refused"] += 1
            if case.fault is not None:
                counts["faults"] += 1
                if case.fault.kind not in kinds:
                    kept = options.keep / f"{case.number}-{Path(name).name}"
                    kept.write_bytes(case.content)
                    found = {"kind": case.fault.kind, "text": case.fault.text, "number": case.number}
                    print(json.dumps({"fault": name, **found, "kept": str(kept)}), flush=True)
                kinds.add(case.fault.kind)
            if counts["taken"] + counts["refused"] >= options.count or time.monotonic() > end:
                break
    print(json.dumps({"target": name, **counts}), flush=True)
    return len(kinds)


if __name__ == "__main__":
    main()
