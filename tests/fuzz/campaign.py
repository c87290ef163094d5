"""Fuzz readers longer, and say what it came to: `python -m tests.fuzz.campaign --cases 1000`."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from tests.fuzz import read_cameras, readers, record_exports, records
from tests.fuzz.harness import SEED, fuzz

# Each says in `NAMES` which targets it has.
_MODULES = (readers, read_cameras, records, record_exports)


def main() -> None:
    """Fuzz the targets that are named, or all, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help="e.g. LAS, or module:NAME of another module")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    n_cases = n_findings = 0
    _say("reader             cases  refused   peak MiB  slowest s   (case)  findings")
    known = {name: module.__name__ for module in _MODULES for name in module.NAMES}
    for target in options.targets or known:
        name = target if ":" in target else f"{known[target]}:{target}"
        folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
        outcome = fuzz(
            name, folder, seed=options.seed, budget_s=options.seconds, most_cases=options.cases
        )
        _say(
            f"{target:16} {outcome.n_cases:7d} {outcome.n_refused:8d} {outcome.peak_mib:10.0f} "
            f"{outcome.slowest_s:10.3f} {outcome.slowest_case:8d} {len(outcome.findings):9d}"
        )
        if outcome.findings:
            _say(outcome.report())
        else:
            shutil.rmtree(folder)
        n_cases += outcome.n_cases
        n_findings += len(outcome.findings)
    _say(f"{n_cases} cases, {n_findings} findings")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
