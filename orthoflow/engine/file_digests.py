"""SHA-256 of input files, remembered as long as the file system says they are the same."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import write_whole
from orthoflow.engine.results import RecordedFile
from orthoflow.errors import InputError
from orthoflow.geometry.threads import in_order

# A file changed this shortly before hashing may change again within the same time stamp.
_SETTLED_NS: Final = 2_000_000_000


@dataclass(frozen=True, kw_only=True)
class FileRef(RecordedFile):
    """An input file by name and content, where it lies.

    Attributes:
        mtime_ns: when it was last changed; only to notice a change while a step reads it.
    """

    mtime_ns: int


class FileDigests:
    """Digests of files, memoised by (device, inode, size, mtime, ctime) in a disposable file."""

    def __init__(self, memo: Path) -> None:
        self._memo = memo
        self._known = _read_memo(memo)
        self._is_dirty = False

    def digest_all(self, paths: Iterable[Path]) -> tuple[FileRef, ...]:
        """Give the digests of files, in their order; large new files are read in parallel.

        Raises:
            InputError: a file cannot be read.
        """
        return tuple(in_order(self.digest, paths, threads=4))

    def digest(self, path: Path) -> FileRef:
        """Give the digest of one file.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            before = path.stat()
            identity = _identity(before)
            known = self._known.get(identity)
            sha256 = known or file_sha256(path)
            after = path.stat()
        except OSError as error:
            raise InputError(f"cannot read the input file {path}: {error.strerror}") from error
        if _identity(after) != identity:
            raise InputError(f"the input file {path} changed while it was read; run again")
        if known is None and time.time_ns() - after.st_mtime_ns > _SETTLED_NS:
            self._known[identity] = sha256
            self._is_dirty = True
        return FileRef(
            name=path.name,
            size_bytes=after.st_size,
            sha256=sha256,
            mtime_ns=after.st_mtime_ns,
        )

    def save(self) -> None:
        """Keep what is new for the next run.

        Raises:
            StoreError: the disk refuses.
        """
        if self._is_dirty:
            write_whole(self._memo, json.dumps(self._known, sort_keys=True).encode())
            self._is_dirty = False


def _identity(stat: os.stat_result) -> str:
    return f"{stat.st_dev}:{stat.st_ino}:{stat.st_size}:{stat.st_mtime_ns}:{stat.st_ctime_ns}"


def file_sha256(path: Path) -> str:
    """Give the SHA-256 of a file as 64 hexadecimal digits.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_memo(memo: Path) -> dict[str, str]:
    try:
        content = json.loads(memo.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(k): str(v) for k, v in content.items()} if isinstance(content, dict) else {}
