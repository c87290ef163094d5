"""Fuzzing of readers: each case in a process that may die, watched for time, memory and writes.

A reader may return something or refuse; anything else is a finding. Cases follow from (group,
seed, number), so that one that failed can be repeated:

    ORTHOFLOW_FUZZ_SEED=3 ORTHOFLOW_FUZZ_CASE=1729 python -m pytest tests/fuzz -k scans

Targets of a group take turns in one process: what is loaded, compiled or opened once is paid once.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Final

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
# `.ci/run` asks for cases; the plain suite reads what once failed (`test_known_cases.py`) only.
IS_FUZZED: Final = bool(CASE or os.environ.get("ORTHOFLOW_FUZZ_CASES"))

MAX_CPU_S: Final = 5.0
MAX_WALL_S: Final = 60.0
MAX_MEMORY_MIB: Final = 1536.0
_MAX_FINDINGS: Final = 20
# Libraries leak where they fail: libE57 half a megabyte for each of its files.
_MAX_PER_PROCESS: Final = 4000
_OWN: Final = frozenset({"seeds", "case", "findings", "output"})


@dataclass(frozen=True, kw_only=True)
class Target:
    """A reader that is given damaged files.

    Attributes:
        seeds: writes small files into an empty folder that the reader takes.
        read: reads one file; it may write into that file's folder and nowhere else.
        mutate: what damages the files.
        refusals: what the reader may raise.
        max_cpu_s: processor time that a case may take.
        max_mib: resident memory that the reading process may take, libraries included.
    """

    seeds: Callable[[Path], object]
    read: Callable[[Path], object]
    mutate: Mutate = mutate_bytes
    refusals: tuple[type[BaseException], ...] = (OrthoflowError,)
    max_cpu_s: float = MAX_CPU_S
    max_mib: float = MAX_MEMORY_MIB


@dataclass(kw_only=True)
class Outcome:
    """What came of fuzzing a group: cases that ran, those refused, and what is to be mended.

    `findings` has one text for each kind (`traceback`, `crash`, `hang`, `memory`, `write`) and
    place, with the damaged file, which is kept, and how the case can be repeated.
    """

    n_cases: int = 0
    n_refused: int = 0
    findings: dict[str, str] = field(default_factory=dict)


def targets_of(group: str) -> Sequence[Target]:
    """Return the targets of an import string such as `tests.fuzz.readers:SCANS`."""
    module, _, attribute = group.partition(":")
    found: Sequence[Target] = getattr(import_module(module), attribute)
    return found


def write_case(group: str, seed: int, case: int, seeds: Path, folder: Path) -> Path:
    """Write the file of a case; `seeds` has a folder for each target."""
    rng = Random(f"{group}/{seed}/{case}")
    targets = targets_of(group)
    number = case % len(targets)
    contents = _contents(seeds / str(number))
    chosen = rng.choice(list(contents))
    path = folder / chosen
    path.write_bytes(targets[number].mutate(contents[chosen], rng, list(contents.values())))
    return path


@cache
def _contents(seeds: Path) -> Mapping[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(seeds.iterdir())}


def fuzz(
    group: str,
    folder: Path,
    *,
    seed: int = SEED,
    budget_s: float = BUDGET_S,
    most_cases: int = N_CASES,
) -> Outcome:
    """Fuzz a group of targets until the time is over or all cases have run.

    Args:
        group: import string of the targets.
        folder: takes seeds and findings; must be empty.
        seed: of the cases.
        budget_s: seconds for each target, beginning when the seeds have been read.
        most_cases: of each target; end earlier after so many, unless 0.
    """
    for part in ("seeds", "case", "findings"):
        (folder / part).mkdir(parents=True)
    targets = targets_of(group)
    for number, target in enumerate(targets):
        (folder / "seeds" / str(number)).mkdir()
        target.seeds(folder / "seeds" / str(number))
    outcome = Outcome()
    first, most = (int(CASE), 1) if CASE else (0, most_cases * len(targets) or sys.maxsize)
    left_s = budget_s * len(targets)
    while left_s > 0.0 and outcome.n_cases < most and len(outcome.findings) < _MAX_FINDINGS:
        count = min(_MAX_PER_PROCESS, most - outcome.n_cases)
        start = first + outcome.n_cases
        left_s -= _fuzz_in_process(outcome, group, seed, folder, start, count, left_s)
    return outcome


def _fuzz_in_process(
    outcome: Outcome, group: str, seed: int, folder: Path, first: int, count: int, budget_s: float
) -> float:
    """Run cases until the process ends, however it does; return the seconds that they took."""
    case, began = first, 0.0

    def add(kind: str, text: str) -> None:
        # What differs from case to case is behind the colon.
        place = f"{kind}: {text.partition(': ')[0]}"
        if place in outcome.findings:
            return
        kept = folder / "findings" / str(case)
        kept.mkdir(exist_ok=True)
        file = write_case(group, seed, case, folder / "seeds", kept)
        outcome.findings[place] = (
            f"{kind}: {text}\nfile: {file}\n"
            f"again: ORTHOFLOW_FUZZ_SEED={seed} ORTHOFLOW_FUZZ_CASE={case} "
            f"python -m pytest tests/fuzz -k {group.rpartition(':')[2].lower()}"
        )

    # A process of its own kind: pytest's has threads, and modules that a reader may change.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    arguments = (group, seed, first, count, folder, budget_s, sender)
    process = context.Process(target=read_cases, args=arguments, daemon=True)
    process.start()
    sender.close()
    with suppress(EOFError):
        while True:
            kind, text = receiver.recv()
            if kind == "case":
                case, began = int(text), began or time.monotonic()
                outcome.n_cases += 1
            elif kind == "refused":
                outcome.n_refused += 1
            else:
                add(kind, text)
    process.join()
    output = (folder / "output").read_text(errors="replace") if process.exitcode else ""
    # A broken harness must not look like a reader that is never asked.
    assert began, f"no case was read: {output}"
    if process.exitcode:
        kind, text = _death(-process.exitcode)
        # Where it happened, as the faulthandler printed it: innermost first.
        frames = re.findall(r'File "([^"]*)", line (\d+)', output)[:3]
        place = "".join(f" < {Path(path).name}:{line}" for path, line in frames)
        add(kind, f"{text}{place}: {output[:3000]}")
    strays = {item.name for item in folder.iterdir()} - _OWN
    if strays:
        add("write", f"left outside its folder: {strays}")
    return time.monotonic() - began


def _death(number: int) -> tuple[str, str]:
    if number == signal.SIGPROF:
        return "hang", "too much processor time"
    if number == signal.SIGALRM:
        return "hang", f"more than {MAX_WALL_S:g} s"
    text = f"ended by {signal.Signals(number).name}" if number > 0 else "the harness failed"
    return "crash", text


# The process that reads one damaged file after the other ------------------------------------------


# Address space beyond what is taken when reading begins: what asks for more gets a MemoryError.
_ADDRESS_SPACE: Final = 4 << 30


def read_cases(
    group: str, seed: int, first: int, count: int, folder: Path, budget_s: float, sender: Connection
) -> None:
    """Read cases until the time is over, and send what becomes of each as (kind, text)."""
    targets, case_folder, seeds = targets_of(group), folder / "case", folder / "seeds"
    os.chdir(case_folder)
    # As a step has it, whose TMPDIR is its scratch folder.
    tempfile.tempdir = str(case_folder)
    # What libraries print; of the last case it is kept.
    output = os.open(folder / "output", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    faulthandler.enable(2)
    for signal_number in (signal.SIGPROF, signal.SIGALRM):
        faulthandler.register(signal_number, 2, chain=True)
    # What is loaded, compiled or opened once is no case's cost.
    for number, target in enumerate(targets):
        for sound in sorted((seeds / str(number)).iterdir()):
            _empty(case_folder)
            target.read(Path(shutil.copy(sound, case_folder)))
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + _ADDRESS_SPACE,) * 2)
    end = time.monotonic() + budget_s
    for case in range(first, first + count):
        _empty(case_folder)
        target = targets[case % len(targets)]
        path = write_case(group, seed, case, seeds, case_folder)
        sender.send(("case", str(case)))
        os.truncate(2, 0)
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        signal.setitimer(signal.ITIMER_PROF, target.max_cpu_s)
        signal.setitimer(signal.ITIMER_REAL, MAX_WALL_S)
        try:
            # As a test would have it, and as no user has: nothing may hang on it.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                target.read(path)
        except target.refusals:
            sender.send(("refused", ""))
        except BaseException as error:  # noqa: BLE001 - whatever it is, it is a finding
            sender.send(("traceback", _described(error)))
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        peak_mib = _peak_mib()
        if peak_mib > target.max_mib:
            sender.send(("memory", f"took {peak_mib:.0f} MiB at case {case}"))
        if time.monotonic() > end:
            break
    # Without what libraries do at exit: that is not what is tested.
    sender.close()
    os._exit(0)


def _described(error: BaseException) -> str:
    """Return class, message and the last places of an error, without what differs by case."""
    frames = traceback.extract_tb(error.__traceback__)[-4:]
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames))
    return f"{type(error).__name__} at {places}: {str(error)[:200]}"


def _empty(folder: Path) -> None:
    for item in folder.iterdir():
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item, ignore_errors=True)
        else:
            item.unlink()


def _peak_mib() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return 0.0
