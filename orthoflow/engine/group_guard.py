"""Kills what steps started when the coordinator dies: processes that would outlive both.

A step dies with its coordinator by itself, because the kernel ties a child to its parent. What the
step started is tied to the step alone, and would go on. So a process of its own keeps a list of the
steps' groups and reads a pipe that the kernel ends however the coordinator dies.

It runs as a script and imports nothing of ours: it is there at once and takes hardly any memory.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterable


class GroupGuard:
    """The coordinator's end; the other process begins with the first group."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def watch(self, group: int) -> None:
        """Kill this process group if the coordinator dies before `forget`."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", __file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                # Ctrl-C and kills of the coordinator's group are not meant for it.
                start_new_session=True,
            )
        self._tell(f"+{group}")

    def forget(self, group: int) -> None:
        """Leave this group alone from now on; call it before its number can be another's."""
        self._tell(f"-{group}")

    def close(self) -> None:
        """End the other process; groups that were not forgotten are killed."""
        if self._process is not None:
            self._process.communicate()
            self._process = None

    def _tell(self, line: str) -> None:
        if self._process is not None and self._process.stdin is not None:
            # Somebody may have killed it: steps go on without.
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(f"{line}\n".encode())
                self._process.stdin.flush()


def guard(lines: Iterable[str]) -> None:
    """Keep the list that `+<group>` and `-<group>` tell, and kill what is on it at the end."""
    groups: set[int] = set()
    for line in lines:
        change = groups.add if line[0] == "+" else groups.discard
        change(int(line[1:]))
    for group in groups:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


if __name__ == "__main__":
    guard(sys.stdin)
