"""A folder in memory for all that tests write, where the machine has one with room in it.

Stores, runs and records bring each file and each folder to the disk before they go on, some forty
times for a run of three cells, and a disk takes milliseconds for each. What tests look at is that
and when they ask for it; in memory they ask just the same. `--basetemp` names another place, where
the files stay after the tests.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import psutil

_MEMORY: Final = Path("/dev/shm")
_NAME: Final = "orthoflow-tests"
# All tests leave 3 GB, and each process with what it starts takes 1.5.
_ROOM_BYTES: Final = 6 << 30
_LEFT_BYTES: Final = 10 << 30


def has_room() -> bool:
    """Whether there is a folder in memory that holds what tests write, and memory beside it."""
    if not os.access(_MEMORY, os.W_OK):
        return False
    is_large = shutil.disk_usage(_MEMORY).free > _ROOM_BYTES
    return is_large and psutil.virtual_memory().available > _LEFT_BYTES


@contextmanager
def in_memory() -> Iterator[None]:
    """Let this process, and all that it starts, write temporary files into memory."""
    _remove_those_of_killed_tests()
    folder = tempfile.mkdtemp(prefix=f"{_NAME}-{os.getpid()}-", dir=_MEMORY)
    before = os.environ.get("TMPDIR")
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    try:
        yield
    finally:
        os.environ.pop("TMPDIR")
        if before is not None:
            os.environ["TMPDIR"] = before
        tempfile.tempdir = None
        _remove(folder)


def _remove_those_of_killed_tests() -> None:
    for folder in _MEMORY.glob(f"{_NAME}-*-*"):
        process = folder.name.split("-")[2]
        if not Path("/proc", process).exists():
            _remove(folder)


def _remove(folder: Path | str) -> None:
    # Some are nested too deeply for Python, and some may be read only.
    subprocess.run(["chmod", "-R", "u+rwX", folder], stderr=subprocess.DEVNULL, check=False)
    subprocess.run(["rm", "-rf", "--", folder], stderr=subprocess.DEVNULL, check=False)
