"""What the process of one step does once it is forked."""

from __future__ import annotations

import dataclasses
import faulthandler
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn

from orthoflow.engine.durability import write_whole
from orthoflow.engine.results import CellResult, result_to_json
from orthoflow.engine.running import run_task
from orthoflow.engine.tasks import Task, read_task
from orthoflow.errors import StoreError
from orthoflow.foreign_text import shown
from orthoflow.sdk.context import StepEvent

_OOM_SCORE: Final = "900"
_PROGRESS_EVERY_S: Final = 0.1


class ProgressPipe:
    """Writes events as JSON lines to the coordinator's pipe; threads may share it."""

    def __init__(self, descriptor: int) -> None:
        """Take an open descriptor."""
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._last = 0.0
        self._sent = 0.0
        self._text = ""

    def listen(self, event: StepEvent) -> None:
        """Pass on an event; progress at most ten times a second, the rest into the log too.

        Another text of the same fraction is another activity, and always passed on.
        """
        if event.kind == "progress":
            is_soon = time.monotonic() - self._last < _PROGRESS_EVERY_S
            is_same_text = event.text == self._text
            if is_soon and event.fraction < 1.0 and (event.fraction > self._sent or is_same_text):
                return
            self._last, self._sent, self._text = time.monotonic(), event.fraction, event.text
        else:
            # The method may have closed it, or put something else into its place.
            with suppress(AttributeError, OSError, ValueError):
                sys.stderr.write(shown(event.text, keep="\n") + "\n")
        self.send(dataclasses.asdict(event))

    def send(self, content: dict[str, object]) -> None:
        """Write one line; without a coordinator there is nobody to work for."""
        line = json.dumps(content, ensure_ascii=True).encode() + b"\n"
        try:
            with self._lock:
                while line:
                    line = line[os.write(self._descriptor, line) :]
        except BrokenPipeError:
            os._exit(1)
        except OSError:
            # The method closed it: it works on unheard.
            return


class StopRequest:
    """Remembers that SIGTERM came."""

    def __init__(self) -> None:
        self.is_set = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal."""
        self.is_set = True


def volunteer_for_oom_killer() -> None:
    """Be the first that the kernel kills when memory runs out, instead of the coordinator."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE, encoding="ascii")


def run_step(task_file: str, descriptor: int, at_end: Callable[[], None]) -> NoReturn:
    """Run one task and leave its result beside it.

    Args:
        task_file: of the task.
        descriptor: of the coordinator's pipe.
        at_end: called when the result is there.
    """
    volunteer_for_oom_killer()
    os.set_inheritable(descriptor, False)  # noqa: FBT003
    stop = StopRequest()
    signal.signal(signal.SIGTERM, stop)
    faulthandler.enable()
    pipe = ProgressPipe(descriptor)
    try:
        task = read_task(Path(task_file))
    except StoreError as error:
        pipe.send({"kind": "failed", "text": str(error)})
        os._exit(1)
    result = run_task(task, pipe.listen, lambda: stop.is_set, has_own_process=True)
    _leave(task, result, pipe)
    at_end()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.flush()
    # Without the interpreter's tear-down: libraries crash there, and threads may never end.
    os._exit(0)


def _leave(task: Task, result: CellResult, pipe: ProgressPipe) -> None:
    try:
        write_whole(task.result_file, result_to_json(result).encode())
    except StoreError as error:
        reason = result.error_message or str(error)
        pipe.send({"kind": "failed", "text": reason})
