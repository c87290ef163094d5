"""A file that HDF5 writes to: it never complains, remembers the first error, and reads back."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from orthoflow_provenance.hdf5 import FileSink


def test_what_stood_there_is_lost_but_nothing_behind_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "link"
    path.write_bytes(b"before")
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic links"):
        FileSink(link)
    assert path.read_bytes() == b"before"
    FileSink(path).close()
    assert path.read_bytes() == b""


def test_what_a_full_disk_did_not_take_is_read_back_and_the_first_error_raised_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = FileSink(tmp_path / "a")
    assert sink.write(memoryview(b"whole")) == 5

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    sink.seek(3)
    assert sink.write(memoryview(b"ABCD")) == 4
    assert (sink.tell(), sink.seek(0, os.SEEK_END)) == (7, 7)
    # The latest of several at one place counts; what nobody wrote is zeros.
    sink.seek(5)
    sink.write(memoryview(b"x"))
    buffer = bytearray(9)
    sink.seek(0)
    assert sink.readinto(memoryview(buffer)) == 9
    assert buffer == b"whoABxD\0\0"
    with pytest.raises(OSError, match="No space left on device"):
        sink.close()
    assert (tmp_path / "a").read_bytes() == b"whole"
