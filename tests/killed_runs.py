"""Runs that are killed: one process that has loaded everything and forks a run for each order.

    python tests/killed_runs.py FOLDER

Reads orders from stdin, a JSON object per line, and answers each with one: `arguments` of the
command line; `event`, the number of the audit event (opening, renaming, removing a file ...) at
which the run kills itself, or `seconds`, after which it is killed. The answer has `code`, negative
for a signal, and `events`, how many there were before the run ended by itself.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def run_forked(arguments: Sequence[str], *, event: int | None, seconds: float | None) -> int:
    """Run the command line in a fork of this process, killed or not; give its exit code."""
    process = os.fork()
    if process == 0:
        signal.alarm(300)  # a run that hangs ends the test, not the patience of whoever waits
        _be_the_run(arguments, event)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(process, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


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
    # What runs print goes nowhere: they share this process's output.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    for line in sys.stdin:
        order = json.loads(line)
        Path("events").write_text("0")
        if order.get("here"):
            code = run_here(order["arguments"])
        else:
            code = run_forked(
                order["arguments"], event=order.get("event"), seconds=order.get("seconds")
            )
        events = int(Path("events").read_text() or "0")  # empty: killed while it was written
        answers.write(json.dumps({"code": code, "events": events}) + "\n")
        answers.flush()


if __name__ == "__main__":
    _main()
