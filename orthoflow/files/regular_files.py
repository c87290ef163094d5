"""Files in places where there may be a pipe, which never ends to be waited for, or a device."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader, TextIOWrapper
from pathlib import Path

from orthoflow.system import flags


def open_file(path: Path) -> BufferedReader:
    """Open a file for reading, at once.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe or a device.
    """
    descriptor = os.open(path, flags("O_RDONLY", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC"))
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is a folder, a pipe or a device", str(path))


def text_of_file(path: Path) -> str:
    """Read a text, UTF-8 with or without a mark at its beginning.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe or a device.
        UnicodeDecodeError: it is no text.
    """
    with TextIOWrapper(open_file(path), encoding="utf-8-sig") as stream:
        return stream.read()
