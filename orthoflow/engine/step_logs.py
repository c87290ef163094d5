"""The log of a step: what it prints, bounded on the disk and in what is kept of it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import writing_to
from orthoflow.system import flags, read_at

# Of a long log the end is kept: what went wrong stands last.
_LOOKS: Final = 10
_KEPT_BYTES: Final = 256 << 10
_LARGEST_BYTES: Final = 8 << 20


class StepLog:
    """An open log that another process appends to, while this one keeps it short.

    It stays open: under its name there may be anything by the time that the step has ended.

    Attributes:
        descriptor: for the standard output of the other process.
    """

    def __init__(self, path: Path) -> None:
        """Begin an empty log.

        Raises:
            StoreError: it cannot be written.
        """
        opened = flags("O_RDWR", "O_CREAT", "O_TRUNC", "O_APPEND", "O_NOFOLLOW")
        with writing_to(path.parent):
            self.descriptor = os.open(path, opened, 0o666)
        self._n_dropped = 0
        self._notice = b""

    def shorten(self) -> None:
        """Drop all but the end of a log that has grown too long; who appends goes on behind it."""
        size = os.fstat(self.descriptor).st_size
        if size <= _LARGEST_BYTES:
            return
        tail = self._tail(size)
        # What is written between the look and the cut is lost: look again until nothing was.
        for _ in range(_LOOKS):
            grown = os.fstat(self.descriptor).st_size
            if grown == size:
                break
            size, tail = grown, self._tail(grown)
        self._n_dropped += size - len(self._notice) - len(tail)
        self._notice = f"... ({self._n_dropped} bytes before)\n".encode()
        # A full disk costs the log, not the run.
        with contextlib.suppress(OSError):
            os.ftruncate(self.descriptor, 0)
            os.write(self.descriptor, self._notice + tail)

    def text(self) -> str:
        """The end of the log, without the NUL characters that no text in a record may have."""
        size = os.fstat(self.descriptor).st_size
        tail = self._tail(size)
        text = tail.decode("utf-8", errors="replace").replace("\0", "")
        n_before = self._n_dropped + size - len(self._notice) - len(tail)
        return text if size == len(tail) else f"... ({n_before} bytes before)\n{text}"

    def close(self) -> None:
        """Close it; nothing can be asked any more."""
        os.close(self.descriptor)

    def _tail(self, size: int) -> bytes:
        return read_at(self.descriptor, _KEPT_BYTES, max(0, size - _KEPT_BYTES))
