"""Fuzzing of readers: each case in a process that may die, watched for time, memory and writes.

A reader may give something or refuse; anything else is a finding. Cases follow from (target, seed,
number), so that one that failed can be had again:

    ORTHOFLOW_FUZZ_SEED=3 ORTHOFLOW_FUZZ_CASE=1729 python -m pytest tests/fuzz -k las
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Any, Final

from orthoflow.errors import OrthoflowError
from tests.fuzz.mutation import Mutate, mutate_bytes

# Seconds that each reader is fuzzed at most; `.ci/run` gives more.
BUDGET_S: Final = float(os.environ.get("ORTHOFLOW_FUZZ_S", "5"))
# Cases of a target, 0 for as many as the time allows. What must pass everywhere has a number: a
# machine twice as fast would else meet cases that nobody has seen, which is for the long loops.
N_CASES: Final = int(os.environ.get("ORTHOFLOW_FUZZ_CASES", "30"))
SEED: Final = int(os.environ.get("ORTHOFLOW_FUZZ_SEED", "0"))
# One case to repeat instead.
CASE: Final = os.environ.get("ORTHOFLOW_FUZZ_CASE", "")

MOST_CPU_S: Final = 5.0
MOST_WALL_S: Final = 60.0
MOST_MEMORY_MIB: Final = 1536.0
_ROOT: Final = Path(__file__).resolve().parents[2]
_MOST_FINDINGS: Final = 20
# Libraries leak where they fail: libE57 half a megabyte for each file.
_MOST_PER_PROCESS: Final = 500


@dataclass(frozen=True, kw_only=True)
class Target:
    """A reader that is given damaged files.

    Attributes:
        seeds: writes small files into an empty folder that the reader takes.
        read: reads one file; it may write into that file's folder and nowhere else.
        mutate: what damages the files.
        refusals: what the reader may raise.
        most_cpu_s: processor time that a case may take.
        most_mib: resident memory that the reading process may take, libraries included.
    """

    seeds: Callable[[Path], object]
    read: Callable[[Path], object]
    mutate: Mutate = mutate_bytes
    refusals: tuple[type[BaseException], ...] = (OrthoflowError,)
    most_cpu_s: float = MOST_CPU_S
    most_mib: float = MOST_MEMORY_MIB


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A case that neither gave something nor was refused as it should.

    Attributes:
        case: its number.
        kind: `traceback`, `crash`, `hang`, `memory` or `write`.
        text: what happened.
        file: the damaged file, kept.
    """

    case: int
    kind: str
    text: str
    file: Path


@dataclass(kw_only=True)
class Outcome:
    """What came of fuzzing a target.

    Attributes:
        n_cases: cases that ran.
        n_refused: those of them that the reader refused.
        peak_mib: peak of the reading process's resident memory, libraries included.
        slowest_s: processor time of the slowest case.
        slowest_case: its number.
        findings: what is to be mended.
    """

    name: str
    seed: int
    n_cases: int = 0
    n_refused: int = 0
    peak_mib: float = 0.0
    slowest_s: float = 0.0
    slowest_case: int = -1
    findings: list[Finding] = field(default_factory=list)

    def report(self) -> str:
        """Say what was found, and how each case can be had again."""
        lines = [f"{self.name}: {len(self.findings)} findings in {self.n_cases} cases"]
        for finding in self.findings:
            lines += [
                f"--- {finding.kind}: {finding.text}",
                f"file: {finding.file}",
                (
                    f"again: ORTHOFLOW_FUZZ_SEED={self.seed} ORTHOFLOW_FUZZ_CASE={finding.case} "
                    f"python -m pytest tests/fuzz -k {self.name.rpartition(':')[2].lower()}"
                ),
            ]
        return "\n".join(lines)


def target_named(name: str) -> Target:
    """Give the target of an import string such as `tests.fuzz.readers:LAS`."""
    module, _, attribute = name.partition(":")
    found: Target = getattr(import_module(module), attribute)
    return found


def write_case(name: str, seed: int, case: int, seeds: Path, folder: Path) -> Path:
    """Write the file of a case."""
    rng = Random(f"{name}/{seed}/{case}")
    contents = _contents(seeds)
    chosen = rng.choice(list(contents))
    path = folder / chosen
    path.write_bytes(target_named(name).mutate(contents[chosen], rng, list(contents.values())))
    return path


@cache
def _contents(seeds: Path) -> Mapping[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(seeds.iterdir())}


def fuzz(
    name: str,
    folder: Path,
    *,
    seed: int = SEED,
    budget_s: float = BUDGET_S,
    most_cases: int = N_CASES,
) -> Outcome:
    """Fuzz a target until the time is over or all cases have run.

    Args:
        name: import string of the target.
        folder: takes seeds and findings; must be empty.
        seed: of the cases.
        budget_s: seconds, beginning when the seeds have been read.
        most_cases: end earlier after so many, unless 0.
    """
    for part in ("seeds", "case", "findings"):
        (folder / part).mkdir(parents=True)
    target_named(name).seeds(folder / "seeds")
    outcome = Outcome(name=name, seed=seed)
    first, most = (int(CASE), 1) if CASE else (0, most_cases or sys.maxsize)
    left_s = budget_s
    while left_s > 0.0 and outcome.n_cases < most:
        request = {
            "name": name,
            "folder": str(folder),
            "seed": seed,
            "first": first + outcome.n_cases,
            "most": min(_MOST_PER_PROCESS, most - outcome.n_cases),
            "budget_s": left_s,
        }
        for answer in _server().ask(request):
            left_s -= _take(outcome, answer, folder)
        if len(outcome.findings) >= _MOST_FINDINGS:
            break
    return outcome


def _take(outcome: Outcome, answer: Mapping[str, Any], folder: Path) -> float:
    """Put what the server said into the outcome; gives the seconds that went by."""
    if answer["kind"] == "ended":
        outcome.n_cases += answer["n_cases"]
        outcome.n_refused += answer["n_refused"]
        outcome.peak_mib = max(outcome.peak_mib, answer["peak_mib"])
        if answer["slowest_s"] > outcome.slowest_s:
            outcome.slowest_s, outcome.slowest_case = answer["slowest_s"], answer["slowest_case"]
        return float(answer["seconds"])
    case, kind, text = int(answer["case"]), str(answer["kind"]), str(answer["text"])
    # The first of each kind and place: what differs is behind the colon.
    known = {(finding.kind, finding.text.partition(": ")[0]) for finding in outcome.findings}
    if (kind, text.partition(": ")[0]) not in known:
        kept = folder / "findings" / f"{outcome.seed}-{case}"
        kept.mkdir(exist_ok=True)
        file = write_case(outcome.name, outcome.seed, case, folder / "seeds", kept)
        outcome.findings.append(Finding(case=case, kind=kind, text=text, file=file))
    return 0.0


def _environment() -> dict[str, str]:
    """What the process is told."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


class _Server:
    """The process that has everything loaded and forks one that reads."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=_ROOT,
            env=_environment(),
            text=True,
        )
        atexit.register(self._process.kill)

    def ask(self, request: Mapping[str, object]) -> Iterator[Mapping[str, Any]]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            answer = json.loads(line)
            yield answer
            if answer["kind"] == "ended":
                return
        raise AssertionError("the process that reads damaged files did not start; see above")


@cache
def _server() -> _Server:
    return _Server()
