"""Processes that decode blocks of point files into memory that this one shares, a few ahead."""

from __future__ import annotations

import contextlib
import mmap
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

# Blocks that a process may be ahead.
_SLOTS: Final = 2


def can_share_memory() -> bool:
    """Whether processes can share memory without a name, as on Linux."""
    return hasattr(os, "memfd_create")


class Decoder:
    """A process that decodes blocks, one after the other, into slots of shared memory.

    It is run with the shared memory's descriptor, the bytes of a slot and what else it is told. It
    decodes a block for each line of its input, and says so in a line.
    """

    def __init__(
        self, worker: Path, told: Sequence[str], *, slot_bytes: int, order: str | None = None
    ) -> None:
        """Start it; it may decode as many blocks at once as there are slots.

        Args:
            worker: the program.
            told: its further arguments.
            slot_bytes: of the largest block.
            order: first line of its input, where that is too long for an argument.
        """
        shared = os.memfd_create("points")
        try:
            os.ftruncate(shared, _SLOTS * slot_bytes)
            self._memory = mmap.mmap(shared, _SLOTS * slot_bytes)
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(worker), str(shared), str(slot_bytes), *told],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=(shared,),
                # It imports what this process would, wherever that came from.
                env=dict(os.environ) | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        finally:
            os.close(shared)
        self._slot_bytes = slot_bytes
        self._slot = 0
        if order is not None:
            self._write(order.encode() + b"\n")
        for _ in range(_SLOTS):
            self.allow()

    def allow(self) -> None:
        """Let it decode one more block, since the oldest one is done with."""
        self._write(b"\n")

    def _write(self, text: bytes) -> None:
        assert self._process.stdin is not None  # noqa: S101 - of a pipe that was asked for
        # Where it has ended, the next line says why.
        with contextlib.suppress(BrokenPipeError):
            while text:
                text = text[self._process.stdin.write(text) :]

    def line(self) -> str:
        """Wait for what it says next; empty when it has ended."""
        assert self._process.stdout is not None  # noqa: S101 - as above
        said = bytearray()
        # A pipe without a buffer gives what is there, which need not be a line.
        while not said.endswith(b"\n") and (part := self._process.stdout.readline()):
            said += part
        return said.decode("utf-8", errors="replace").strip()

    def ended_with(self) -> int:
        """Wait for its end."""
        return self._process.wait()

    def slot(self) -> memoryview:
        """The memory of the next block."""
        start = self._slot * self._slot_bytes
        self._slot = (self._slot + 1) % _SLOTS
        return memoryview(self._memory)[start : start + self._slot_bytes]

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait()
