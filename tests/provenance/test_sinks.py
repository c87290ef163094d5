"""A file that HDF5 writes to: it never complains, remembers the first error, and reads back."""

from __future__ import annotations

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
