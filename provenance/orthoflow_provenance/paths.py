"""Safe access to files with untrusted names: only regular files, and only inside a given folder.

Names from records, crates, archives and plugins are converted to paths only by this module.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, Final

from orthoflow_provenance.document import RecordFormatError, UnsafeFileError

_LETTER: Final = r"""[^\s/'"<>|,;:()\[\]{}\\]"""
# Matches an absolute path with at least two parts that is not the end of a word, a relative path or
# a URL.
_PATH: Final = re.compile(
    rf"(?<![\w.:/~*?\\-]) (?:file://)? / (?:{_LETTER}+/)+ (?P<last>{_LETTER}*)", re.VERBOSE
)
LONGEST_NAME_BYTES: Final = 255
LONGEST_PATH_BYTES: Final = 4095
# Windows treats these names as devices in every folder, also if a suffix is added.
_DEVICES: Final = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])[ ]*(\..*)?", re.IGNORECASE | re.DOTALL
)
_DRIVE: Final = re.compile(r"[A-Za-z]:")
_FILE_FLAGS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC


def holds_control(text: str) -> bool:
    """Return whether a string has control characters, line separators or unpaired surrogates."""
    return not text.isprintable() and any(
        unicodedata.category(letter) in {"Cc", "Cs", "Zl", "Zp"} for letter in text
    )


def check_name(name: str, what: str) -> str:
    """Check that a name can be the name of an HDF5 link.

    Raises:
        RecordFormatError: the name is empty, `.` or `..`, or contains `/` or a control character.
    """
    if name in {"", ".", ".."} or "/" in name or holds_control(name):
        raise RecordFormatError(
            f"{what} {name!r} cannot be a name in a record: names must not be empty, `.` or "
            "`..`, or contain `/` or control characters"
        )
    return name


_PROBLEMS: Final[tuple[tuple[str, Callable[[str], object]], ...]] = (
    ("is empty", lambda name: not name),
    ("is . or ..", lambda name: name in {".", ".."}),
    ("contains / or a backslash", lambda name: "/" in name or "\\" in name),
    ("contains a control character", holds_control),
    (
        f"is longer than {LONGEST_NAME_BYTES} bytes",
        lambda name: len(name.encode("utf-8")) > LONGEST_NAME_BYTES,
    ),
    ("ends with a dot or a space", lambda name: name[-1] in ". "),
    ("is a reserved device name", _DEVICES.fullmatch),
    ("begins with a drive letter", _DRIVE.match),
)


def name_problem(name: str) -> str:
    """Return why a name is not valid for files and folders on all systems; empty if it is valid.

    >>> name_problem("hall.e57"), name_problem(".."), name_problem("a/b")
    ('', 'is . or ..', 'contains / or a backslash')
    """
    return next((problem for problem, is_found in _PROBLEMS if is_found(name)), "")


def path_problem(path: str) -> str:
    """Return why a relative path with `/` is not valid inside a folder; empty if it is valid.

    >>> path_problem("products/wall/a.tif"), path_problem("/etc/x"), path_problem("a/../b")
    ('', 'is absolute', 'has a part that is . or ..')
    """
    if not path:
        return "is empty"
    if path.startswith("/"):
        return "is absolute"
    if "/" not in path:
        return name_problem(path)
    for part in path.split("/"):
        if problem := name_problem(part):
            return f"has a part that {problem}"
    if len(path.encode("utf-8")) > LONGEST_PATH_BYTES:
        return f"is longer than {LONGEST_PATH_BYTES} bytes"
    return ""


def path_below(folder: Path, path: str) -> Path:
    """Return the path of a file in a folder, given an untrusted relative path.

    Raises:
        UnsafeFileError: the path leads out of the folder or is not valid on all systems, because it
            is absolute, empty or too long, or contains `..`, control characters or reserved names.
    """
    if problem := path_problem(path):
        raise UnsafeFileError(f"{path!r} {problem}, so it cannot be a file name here")
    return folder.joinpath(*path.split("/"))


def colliding(paths: Iterable[str]) -> str:
    """Return the first path that equals an earlier one on some systems; empty if there is none.

    >>> colliding(["a.png", "b.png", "A.png"])
    'A.png'
    """
    seen: set[str] = set()
    for path in paths:
        folded = unicodedata.normalize("NFC", unicodedata.normalize("NFC", path).casefold())
        if folded in seen:
            return path
        seen.add(folded)
    return ""


def open_below(folder: Path, path: str) -> BufferedReader:
    """Open a regular file in a folder for reading; links are not followed.

    Raises:
        UnsafeFileError: the path leads out of the folder, or it is that of a link, a folder or a
            device.
        OSError: the file does not exist or cannot be read.
    """
    target = _without_links(folder, path)
    # Check before opening, because opening a device may have side effects.
    _check_regular(target.lstat(), path)
    descriptor = os.open(target, _FILE_FLAGS)
    try:
        _check_regular(os.fstat(descriptor), path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


@contextmanager
def create_below(folder: Path, path: str) -> Iterator[BinaryIO]:
    """Write a file in a folder; it gets its name when it is complete, and links are not followed.

    Missing folders are created. An existing file or link with this name is replaced.

    Raises:
        UnsafeFileError: the path leads out of the folder, or contains a folder that is a link.
        OSError: the file cannot be written.
    """
    target = _without_links(folder, path)
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with aside.open("xb") as stream:
            yield stream
        aside.replace(target)
    except BaseException:
        with suppress(OSError):
            aside.unlink()
        raise


def files_below(folder: Path, path: str) -> tuple[str, ...]:
    """Return the paths of the regular files in a subfolder; empty if the subfolder does not exist.

    Links are omitted, and so are files whose names are not allowed in a record.

    Raises:
        OSError: the folder cannot be read.
    """
    try:
        with os.scandir(_without_links(folder, f"{path}/x").parent) as entries:
            return tuple(
                entry.name
                for entry in entries
                if entry.is_file(follow_symlinks=False) and not name_problem(entry.name)
            )
    except (FileNotFoundError, NotADirectoryError, UnsafeFileError):
        return ()


def _without_links(folder: Path, path: str) -> Path:
    """Return `path_below`, after checking that no folder below `folder` is a link."""
    target = path_below(folder, path)
    for part in reversed(target.parents):
        if len(part.parts) > len(folder.parts) and part.is_symlink():
            inside = part.relative_to(folder).as_posix()
            raise UnsafeFileError(f"{inside!r} is a link, and links are not followed")
    return target


def _check_regular(found: os.stat_result, path: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        other = "a folder" if stat.S_ISDIR(found.st_mode) else "a device, a pipe or a socket"
        kind = "a link" if stat.S_ISLNK(found.st_mode) else other
        raise UnsafeFileError(f"{path!r} must be a file, but is {kind}")


def without_folders(text: str, folders: Sequence[Path] = ()) -> str:
    """Shorten absolute paths in a string to their last part.

    Args:
        text: a log, a message or a command-line option.
        folders: folders to remove by exact search before absolute paths are shortened. This is
            necessary for names with spaces, because a pattern cannot find their end. The home
            directory and the working directory are always included.

    >>> without_folders("cannot read /home/jane/scans/hall.e57: 1/2 of it is missing")
    'cannot read hall.e57: 1/2 of it is missing'
    """
    for folder in sorted({*map(str, folders), *_own_folders()}, key=len, reverse=True):
        if len(folder) > 1:
            text = text.replace(f"{folder}/", "")
    return _PATH.sub(lambda match: match["last"], text)


def _own_folders() -> set[str]:
    folders = {str(Path.cwd())}
    # If the home directory is unknown, it cannot be removed.
    with suppress(RuntimeError):
        folders.add(str(Path.home()))
    return folders
