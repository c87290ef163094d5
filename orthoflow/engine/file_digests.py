"""SHA-256 digests of input files, cached as long as the file system reports no change.

The cache also contains the paths of the files. Replays and exports need these paths to find the
input files of an earlier run, because records contain no folders.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import is_checked, with_digest, write_whole
from orthoflow.engine.results import RecordedFile, name_problem
from orthoflow.errors import InputError
from orthoflow.geometry.threads import in_order
from orthoflow.sdk.lines import one_line, text_of_path

# A file that was changed less than this time before it was hashed may change again without a new
# time stamp.
_SETTLED_NS: Final = 2_000_000_000


@dataclass(frozen=True, kw_only=True)
class FileRef(RecordedFile):
    """An input file with its name, content and path.

    Attributes:
        path: path of the file.
        identity: file system attributes, used only to detect changes of the file while a step reads
            it.
    """

    path: Path
    identity: str


class FileDigests:
    """Digests of files, cached by (device, inode, size, mtime, ctime) in a disposable file."""

    def __init__(self, memo: Path) -> None:
        self._memo = memo
        self._known, self._places = _read_memo(memo)
        self._is_dirty = False

    def digest_all(self, paths: Iterable[Path]) -> tuple[FileRef, ...]:
        """Return the digests of files, in the order given.

        Large files whose digests are not cached are read in parallel.

        Raises:
            InputError: a file cannot be read.
        """
        return tuple(in_order(self.digest, paths, threads=4))

    def digest(self, path: Path) -> FileRef:
        """Return the digest of one file.

        Raises:
            InputError: the file cannot be read, or its name is not allowed in a record.
        """
        if problem := name_problem(path.name):
            raise InputError(
                f"the input file {path} has a name that {problem}, which some systems do not "
                "allow: rename it"
            )
        if text_of_path(path) is None:
            raise InputError(
                f"the input file {one_line(path)} has a path that is not UTF-8: rename it"
            )
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                raise InputError(
                    f"the input {path} must be a regular file, because inputs are read "
                    "more than once"
                )
            identity = file_identity(path)
            known = self._known.get(identity)
            sha256 = known or file_sha256(path)
            after = path.stat()
            is_same = _identity(after) == identity
        except OSError as error:
            raise InputError(f"cannot read the input file {path}: {error.strerror}") from error
        if not is_same:
            raise InputError(f"the input file {path} changed while it was read; run again")
        if known is None and time.time_ns() - after.st_mtime_ns > _SETTLED_NS:
            self._known[identity] = sha256
            self._is_dirty = True
        return FileRef(
            name=path.name,
            size_bytes=after.st_size,
            sha256=sha256,
            path=path,
            identity=identity,
        )

    def note_place(self, sha256: str, path: Path) -> None:
        """Record the path of a file with a given digest."""
        place = str(path.absolute())
        self._is_dirty |= self._places.get(sha256) != place
        self._places[sha256] = place

    def place(self, sha256: str) -> Path | None:
        """Return the path recorded for a digest; the file there may be missing or changed."""
        place = self._places.get(sha256)
        return None if place is None else Path(place)

    def save(self) -> None:
        """Save new digests for the next run.

        Raises:
            StoreError: the disk cannot be written to.
        """
        if self._is_dirty:
            text = json.dumps({"files": self._known, "places": self._places}, sort_keys=True)
            write_whole(self._memo, with_digest(text).encode())
            self._is_dirty = False


def file_identity(path: Path) -> str:
    """Return file system attributes that stay the same as long as the file is not changed.

    Raises:
        OSError: the file is not accessible.
    """
    return _identity(path.stat())


def _identity(state: os.stat_result) -> str:
    times = f"{state.st_mtime_ns}:{state.st_ctime_ns}"
    return f"{state.st_dev}:{state.st_ino}:{state.st_size}:{times}"


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_memo(memo: Path) -> tuple[dict[str, str], dict[str, str]]:
    try:
        text = memo.read_text(encoding="utf-8")
        content = json.loads(text) if is_checked(text) else {}
        return content["files"], content["places"]
    except (OSError, ValueError, KeyError):
        return {}, {}
