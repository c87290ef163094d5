"""Runs that come to harm: one process that has loaded everything and forks a run for each order.

    python -m tests.killed_runs FOLDER

Reads orders from stdin, a JSON object per line, and answers each with one: `arguments` of the
command line; `event`, the number of the audit event (opening, renaming, removing a file ...) at
which the run kills itself, or `seconds`, after which it is killed; or `fault`, one of
`faulty_files.FAULTS`, and `operation`, the number of the file operation that it befalls. The answer
has `code`, negative for a signal, `events`, how many events or operations there were before the run
ended by itself, and `said`, what it wrote to standard error.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Answer:
    """How a run ended: exit code, events or operations in it, and what it said."""

    code: int
    events: int
    said: str


@dataclass(frozen=True)
class RunServer:
    """The process that forks runs, from outside."""

    folder: Path
    process: subprocess.Popen[str]

    def __call__(self, *arguments: str, **order: object) -> Answer:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"arguments": arguments, **order}) + "\n")
        self.process.stdin.flush()
        return Answer(**json.loads(self.process.stdout.readline()))


@contextmanager
def run_server(folder: Path, environment: Mapping[str, str]) -> Iterator[RunServer]:
    """Start the process; `environment` says which plugins are installed."""
    paths = [str(ROOT / part) for part in ("", "plugins", "provenance")]
    python_path = ":".join([*paths, environment["PYTHONPATH"]])
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.killed_runs", str(folder)],
        env={**environment, "PYTHONPATH": python_path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield RunServer(folder, process)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait() == 0


# Any: an order is JSON that this module wrote itself.
def run_forked(order: Mapping[str, Any]) -> int:
    """Run the command line in a fork of this process, harmed or not; give its exit code."""
    process = os.fork()
    if process == 0:
        signal.alarm(300)  # a run that hangs ends the test, not the patience of whoever waits
        if "fault" in order:
            _be_the_faulty_run(order)
        _be_the_run(order["arguments"], order.get("event"))
    if "seconds" in order:
        time.sleep(order["seconds"])
        os.kill(process, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def _be_the_faulty_run(order: Mapping[str, Any]) -> None:
    from tests.faulty_files import FaultyFiles

    files = FaultyFiles(Path.cwd(), order["fault"], order["operation"], order.get("seed", 0))
    with files.in_place():
        code = run_here(order["arguments"])
    Path("events").write_text(str(files.count))
    os._exit(code)


def _be_the_run(arguments: Sequence[str], event: int | None) -> None:
    count = 0

    def watch(*_: object) -> None:
        nonlocal count
        count += 1
        if count == event:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    code = run_here(arguments)
    Path("events").write_text(str(count))
    os._exit(code)


def run_here(arguments: Sequence[str]) -> int:
    """Run the command line in this process."""
    from orthoflow.cli.program import program

    try:
        program.main(list(arguments))
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 1
    return 0


def _main() -> None:
    os.chdir(sys.argv[1])
    answers = os.fdopen(os.dup(1), "w")
    # What runs print on standard output goes nowhere: they share this process's.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    said = os.open("said.txt", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    os.dup2(said, 2)
    for line in sys.stdin:
        order = json.loads(line)
        Path("events").write_text("0")
        os.ftruncate(said, 0)
        if order.get("here"):
            code = run_here(order["arguments"])
            # Forks look through none of what is loaded by now, nor copy its pages for it.
            gc.collect()
            gc.freeze()
        else:
            code = run_forked(order)
        events = int(Path("events").read_text() or "0")  # empty: killed while it was written
        text = Path("said.txt").read_text(errors="replace")
        answers.write(json.dumps({"code": code, "events": events, "said": text}) + "\n")
        answers.flush()


if __name__ == "__main__":
    _main()
