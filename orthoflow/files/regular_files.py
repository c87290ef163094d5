"""Files in places where there may be a pipe, which never ends to be waited for, or a device."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, TextIOWrapper
from pathlib import Path

from orthoflow.errors import InputError
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


@contextmanager
def reading(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> Iterator[None]:
    """Say what is wrong with a file that is opened and read in here, as an `InputError`.

    Args:
        path: the file.
        most_bytes: a larger one is not read.
        what: it should be, e.g. `a title block (YAML)`.
        way_out: for those whose file is too large.
    """
    try:
        n_bytes = path.stat().st_size
        if n_bytes > most_bytes:
            raise InputError(
                f"{path.name} has {n_bytes} bytes, {what} at most {most_bytes}{way_out}"
            )
        yield
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path.name} is no UTF-8 text: expected {what}; save it as UTF-8"
        ) from error
    except OSError as error:
        raise InputError(f"{path.name} cannot be read: {error.strerror}") from error


def open_text(path: Path) -> TextIOWrapper:
    """Open a text, UTF-8 with or without a mark at its beginning.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe or a device.
    """
    return TextIOWrapper(open_file(path), encoding="utf-8-sig")


def text_of_file(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> str:
    """Read a text whole, with the arguments of `reading`.

    Raises:
        InputError: it cannot be read, is no text, or is too large.
    """
    with reading(path, most_bytes, what, way_out=way_out), open_text(path) as stream:
        return stream.read()
