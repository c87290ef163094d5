"""The process behind `harness`: reads one damaged file after the other."""

from __future__ import annotations

import faulthandler
import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from tests.fuzz.harness import MAX_WALL_S, targets_of, write_case

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
    for number in (signal.SIGPROF, signal.SIGALRM):
        faulthandler.register(number, 2, chain=True)
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
