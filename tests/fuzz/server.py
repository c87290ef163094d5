"""The process behind `harness`: forks one that reads damaged files, and says what became of it.

`python -m tests.fuzz.server` takes requests as JSON lines and answers with JSON lines.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from tests.fuzz.harness import (
    MOST_WALL_S,
    Target,
    target_named,
    write_case,
)

# Address space beyond what is taken when reading begins: what asks for more gets a MemoryError.
_ADDRESS_SPACE: Final = 4 << 30
_MODES: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Audit event -> where its arguments name what is changed, and the folders those names start at.
_CHANGING: Final = {
    **dict.fromkeys(("os.remove", "os.rmdir"), ((0, 1),)),
    "os.mkdir": ((0, 2),),
    "os.rename": ((0, 2), (1, 3)),
    "os.link": ((1, 3),),
    "os.symlink": ((1, 2),),
    **dict.fromkeys(("os.truncate", "os.chmod", "os.chown", "shutil.rmtree"), ((0, None),)),
    **dict.fromkeys(("subprocess.Popen", "os.system"), ((0, None),)),
}
# These change a name, not what a link of that name leads to.
_NAMING: Final = frozenset(
    {"os.remove", "os.rmdir", "os.mkdir", "os.rename", "os.link", "os.symlink"}
)
_OWN: Final = frozenset({"seeds", "case", "findings", "state", "said"})
_STATE: Final = struct.Struct("<qqdqd")


def main() -> None:
    """Serve until nobody asks any more."""
    for line in sys.stdin:
        request = json.loads(line)
        # Loaded once, before the fork; what starts threads does so when it is first used.
        target_named(request["name"])
        # What is loaded is never garbage; a search for it after some cases need not look there.
        gc.freeze()
        _serve(request)


def _serve(request: Mapping[str, Any]) -> None:
    folder = Path(request["folder"])
    state = folder / "state"
    state.write_bytes(_STATE.pack(request["first"], 0, 0.0, -1, 0.0))
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        try:
            _Reading(request).run()
            status = 0
        except BaseException:  # noqa: BLE001 - of the harness itself
            traceback.print_exc()
            status = 17
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    case, n_refused, slowest_s, slowest_case, peak_mib = _STATE.unpack(state.read_bytes())
    n_cases = case - request["first"]
    if status != 0:
        said = (folder / "said").read_text(errors="replace")
        kind, text = _death(-status)
        _say({"kind": kind, "case": case, "text": f"{text}{_place(said)}: {said[:3000]}"})
        n_cases += 1
    strays = {item.name for item in folder.iterdir()} - _OWN
    if strays:
        _say({"kind": "write", "case": case, "text": f"left outside its folder: {strays}"})
    _say(
        {
            "kind": "ended",
            "n_cases": n_cases,
            "n_refused": n_refused,
            "slowest_s": slowest_s,
            "slowest_case": slowest_case,
            "peak_mib": peak_mib,
            "seconds": time.monotonic() - began,
        }
    )


def _death(number: int) -> tuple[str, str]:
    if number == signal.SIGPROF:
        return "hang", "too much processor time"
    if number == signal.SIGALRM:
        return "hang", f"more than {MOST_WALL_S:g} s"
    return (
        "crash",
        f"ended by {signal.Signals(number).name}" if number > 0 else "the harness failed",
    )


def _place(said: str) -> str:
    """Where it happened, as the faulthandler said it: innermost first."""
    frames = re.findall(r'File "([^"]*)", line (\d+)', said)[:3]
    return "".join(f" < {Path(path).name}:{line}" for path, line in frames)


class _Reading:
    """Reads one damaged file after the other."""

    def __init__(self, request: Mapping[str, Any]) -> None:
        self._name: str = request["name"]
        self._target: Target = target_named(self._name)
        self._folder = Path(request["folder"])
        self._request = request
        self._state = os.open(self._folder / "state", os.O_WRONLY)
        self._case: int = request["first"]
        self._n_refused = 0
        self._slowest: tuple[float, int] = (0.0, -1)
        self._peak_mib = 0.0
        self._is_watched = False
        self._writes: list[str] = []

    def run(self) -> None:
        case_folder = self._folder / "case"
        os.chdir(case_folder)
        # As a step has it, whose TMPDIR is its scratch folder.
        tempfile.tempdir = str(case_folder)
        # What libraries print belongs to no protocol; of the last case it is kept.
        answers = os.dup(1)
        sys.stdout = os.fdopen(answers, "w")
        said = os.open(self._folder / "said", os.O_RDWR | os.O_CREAT | os.O_APPEND)
        for descriptor in (1, 2):
            os.dup2(said, descriptor)
        faulthandler.enable(2)
        for number in (signal.SIGPROF, signal.SIGALRM):
            faulthandler.register(number, 2, chain=True)
        self._warm_up(case_folder)
        _limit_memory()
        sys.addaudithook(self._audit)
        end = time.monotonic() + self._request["budget_s"]
        most = self._request["most"]
        while time.monotonic() < end and self._case < self._request["first"] + most:
            _empty(case_folder)
            path = write_case(
                self._name,
                self._request["seed"],
                self._case,
                self._folder / "seeds",
                case_folder,
            )
            self._note()
            os.truncate(2, 0)
            self._read(path)
            self._case += 1
        self._note()

    def _warm_up(self, folder: Path) -> None:
        """Read the seeds: what is loaded, compiled or opened once is no case's cost."""
        for seed in sorted((self._folder / "seeds").iterdir()):
            _empty(folder)
            path = folder / seed.name
            path.write_bytes(seed.read_bytes())
            self._target.read(path)

    def _read(self, path: Path) -> None:
        _reset_peak()
        before = _cpu_s()
        signal.setitimer(signal.ITIMER_PROF, self._target.most_cpu_s)
        signal.setitimer(signal.ITIMER_REAL, MOST_WALL_S)
        self._is_watched = True
        try:
            # As a test would have it, and as no user has: nothing may hang on it.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._target.read(path)
        except self._target.refusals:
            self._n_refused += 1
        except BaseException as error:  # noqa: BLE001 - whatever it is, it is a finding
            self._find("traceback", _told(error))
        finally:
            self._is_watched = False
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        self._slowest = max(self._slowest, (_cpu_s() - before, self._case))
        peak_mib = _peak_mib()
        self._peak_mib = max(self._peak_mib, peak_mib)
        if peak_mib > self._target.most_mib:
            self._find("memory", f"took {peak_mib:.0f} MiB at case {self._case}")
        for write in self._writes:
            self._find("write", write)
        self._writes.clear()

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._is_watched:
            return
        if event == "open":
            if not isinstance(arguments[2], int) or not arguments[2] & _MODES:
                return
        elif event not in _CHANGING:
            return
        for place, start in _CHANGING.get(event, ((0, None),)):
            name = arguments[place]
            folder = -1 if start is None else arguments[start]
            if isinstance(name, str | bytes | os.PathLike) and not self._is_inside(
                _whole(name, folder, is_name=event in _NAMING)
            ):
                self._writes.append(f"{event} of {os.fsdecode(name)!r}")

    def _is_inside(self, whole: str) -> bool:
        allowed = (str(self._folder / "case"), "/dev/null", os.environ.get("NUMBA_CACHE_DIR"))
        return any(part and (whole == part or whole.startswith(f"{part}/")) for part in allowed)

    def _find(self, kind: str, text: str) -> None:
        _say({"kind": kind, "case": self._case, "text": text})

    def _note(self) -> None:
        slowest_s, slowest_case = self._slowest
        noted = _STATE.pack(self._case, self._n_refused, slowest_s, slowest_case, self._peak_mib)
        os.pwrite(self._state, noted, 0)


def _whole(name: Any, folder: int, *, is_name: bool) -> str:
    """The path of a name in a folder that is open, or in the working one (-1)."""
    start = Path.cwd() if folder < 0 else Path(f"/proc/self/fd/{folder}")
    path = start / os.fsdecode(name)
    # Of `..` and what ends in a slash the last part is no name.
    if not is_name or path.name == "..":
        return os.path.realpath(path)
    return str(Path(os.path.realpath(path.parent)) / path.name)


def _told(error: BaseException) -> str:
    """Class, message and the last places of an error, without what differs from case to case."""
    frames = traceback.extract_tb(error.__traceback__)[-4:]
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames))
    return f"{type(error).__name__} at {places}: {str(error)[:200]}"


def _empty(folder: Path) -> None:
    for item in folder.iterdir():
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item, ignore_errors=True)
        else:
            item.unlink()


def _limit_memory() -> None:
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + _ADDRESS_SPACE,) * 2)


def _reset_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mib() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return 0.0


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime + children.ru_utime + children.ru_stime


def _say(answer: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
