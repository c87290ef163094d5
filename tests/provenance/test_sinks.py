"""A file that HDF5 writes to: it never complains, remembers the first error, and reads back."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from orthoflow_provenance import hdf5 as sinks
from orthoflow_provenance.hdf5 import FileSink, create_file

KIB = 1 << 10


def read(sink: FileSink, offset: int, length: int) -> bytes:
    buffer = bytearray(b"?" * length)
    sink.seek(offset)
    assert sink.readinto(memoryview(buffer)) == length
    assert sink.tell() == offset + length
    return bytes(buffer)


def put(sink: FileSink, offset: int, data: bytes) -> None:
    sink.seek(offset)
    assert sink.write(memoryview(data)) == len(data)
    assert sink.tell() == offset + len(data)


def test_what_is_written_is_read_and_what_never_was_is_zeros(tmp_path: Path) -> None:
    sink = FileSink(tmp_path / "a")
    put(sink, 3, b"abcdef")
    assert read(sink, 0, 12) == b"\0\0\0abcdef\0\0\0"
    assert read(sink, 5, 2) == b"cd"
    sink.close()
    assert (tmp_path / "a").read_bytes() == b"\0\0\0abcdef"


def test_a_position_counts_from_the_front_from_itself_or_from_the_end(tmp_path: Path) -> None:
    sink = FileSink(tmp_path / "a")
    put(sink, 0, b"0123456789")
    assert sink.seek(4) == 4
    assert sink.seek(3, os.SEEK_CUR) == 7
    assert sink.seek(-2, os.SEEK_CUR) == 5
    assert sink.seek(0, os.SEEK_END) == 10
    assert sink.seek(-1, os.SEEK_END) == 9
    assert sink.truncate(6) == 6
    assert sink.seek(0, os.SEEK_END) == 6
    sink.close()


def test_a_file_is_written_to_its_end_however_little_the_disk_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = sinks._write_at
    monkeypatch.setattr(
        sinks, "_write_at", lambda file, data, offset: whole(file, data[:3], offset)
    )
    sink = FileSink(tmp_path / "a")
    put(sink, 2, b"0123456789")
    sink.close()
    assert (tmp_path / "a").read_bytes() == b"\0\x000123456789"


@pytest.fixture
def full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FileSink:
    """A sink whose disk was full after the first four bytes."""
    sink = FileSink(tmp_path / "a")
    put(sink, 0, b"good")

    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sinks, "_write_at", refuse)
    put(sink, 4, b"lost")
    return sink


def test_after_a_failure_structures_are_read_back_as_if_they_were_written(full: FileSink) -> None:
    assert full.failure is not None
    assert full.failure.errno == errno.ENOSPC
    put(full, 6, b"XY")
    put(full, 20, b"far")
    assert full.seek(0, os.SEEK_END) == 23
    # The later one of two holds, and what lies between is zeros.
    assert read(full, 0, 24) == b"good" + b"loXY" + bytes(12) + b"far" + b"\0"
    assert read(full, 5, 2) == b"oX"
    assert read(full, 7, 1) == b"Y"
    assert read(full, 8, 4) == bytes(4)


def test_after_a_failure_large_blocks_are_dropped(full: FileSink) -> None:
    put(full, 100, b"k" * (64 * KIB))
    assert full.seek(0, os.SEEK_END) == 100 + 64 * KIB
    assert read(full, 100, 2) == b"kk"
    put(full, 100_000, b"d" * (64 * KIB + 1))
    assert full.seek(0, os.SEEK_END) == 100 + 64 * KIB
    assert read(full, 100_000, 2) == bytes(2)


def test_the_first_failure_is_the_one_that_is_raised(
    full: FileSink, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = full.failure

    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(sinks.os, "ftruncate", refuse)
    monkeypatch.setattr(sinks.os, "fsync", refuse)
    assert full.truncate(2) == 2
    with pytest.raises(OSError, match="No space left on device") as caught:
        full.close()
    assert caught.value is first


def test_a_length_that_cannot_be_set_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = FileSink(tmp_path / "a")

    def refuse(*_: object) -> None:
        raise OSError(errno.EFBIG, "File too large")

    monkeypatch.setattr(sinks.os, "ftruncate", refuse)
    assert sink.truncate(1 << 20) == 1 << 20
    with pytest.raises(OSError, match="File too large"):
        sink.close()


def test_what_stood_there_is_lost_but_nothing_behind_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "link"
    path.write_bytes(b"before")
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic links"):
        FileSink(link)
    assert path.read_bytes() == b"before"
    FileSink(path).close()
    assert path.read_bytes() == b""


def test_a_file_that_could_not_be_completed_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"

    def fail() -> None:
        with create_file(path) as file:
            file["x"] = 1
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        fail()
    assert not path.exists()
    with create_file(path) as file:
        file["x"] = 1
    assert path.read_bytes()[:4] == b"\x89HDF"


def test_equal_content_gives_equal_files_with_arrays_that_can_be_mapped(tmp_path: Path) -> None:
    contents = []
    for name in ("a.h5", "b.h5"):
        with create_file(tmp_path / name) as file:
            sinks.create_group(file, "g")["large"] = np.arange(3000, dtype=np.uint8)
        contents.append((tmp_path / name).read_bytes())
        at = contents[-1].index(np.arange(250, dtype=np.uint8).tobytes())
        assert at % 64 == 0
    assert contents[0] == contents[1]
