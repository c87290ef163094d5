"""Choice of the reader for a point file, from its content and its suffix."""

from __future__ import annotations

import re
from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from typing import Final, NamedTuple

from orthoflow.errors import InputError
from orthoflow.files.points.fields import Columns
from orthoflow.files.points.scan_file import PointQuery, ScanFile

# The densest encodings need a byte for eight points; a file that declares more points for its size
# is refused before memory is allocated for the points.
#: points declared by a file, per byte of its size
MOST_POINTS_PER_BYTE: Final = 8


class Format(NamedTuple):
    """A family of point files.

    Attributes:
        name: usual name of the format.
        suffixes: file suffixes in lower case, with the dot.
        reader: module and function that open the files.
        signature: pattern of the first bytes of a file; None for plain text.
        beginning: expected beginning of a file, for messages.
    """

    name: str
    suffixes: tuple[str, ...]
    reader: tuple[str, str]
    signature: re.Pattern[bytes] | None = None
    beginning: str = ""


_PLY_START: Final = re.compile(rb"ply[\n\r ]", re.IGNORECASE)
# Some programs write a different first line than the standard's, or no comment line.
_PCD_START: Final = re.compile(
    rb"# \.PCD|(?:.*\n)*?[ \t]*(?:fields|columns)[ \t].*\n(?:.*\n)?[ \t]*size[ \t]", re.IGNORECASE
)
_TEXT_SUFFIXES: Final = (
    *(".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzi", ".xyzn", ".xyzrgb", ".tsv"),
)
E57: Final = Format("E57", (".e57",), ("e57", "open_e57"), re.compile(b"ASTM-E57"), "ASTM-E57")
LAS: Final = Format("LAS/LAZ", (".las", ".laz"), ("las", "open_las"), re.compile(b"LASF"), "LASF")
PLY: Final = Format("PLY", (".ply",), ("records", "open_ply"), _PLY_START, "ply")
PCD: Final = Format("PCD", (".pcd",), ("records", "open_pcd"), _PCD_START)
PTX: Final = Format("PTX", (".ptx",), ("ptx", "open_ptx"))
TEXT: Final = Format("text", _TEXT_SUFFIXES, ("text", "open_text"))
FORMATS: Final = (E57, LAS, PLY, PCD, PTX, TEXT)
_SNIFFED_BYTES: Final = 4096


def find_format(path: Path) -> Format:
    """Return a point file's format, from its content if conclusive, else from its suffix.

    Raises:
        InputError: the file is missing or empty, does not match its suffix, or has an unknown
            format.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path.name} must be a point file, but there is {found} at this path")
    try:
        with path.open("rb") as file:
            start = file.read(_SNIFFED_BYTES)
    except OSError as error:
        raise InputError(f"{path.name} cannot be opened: {error.strerror}") from error
    if not start:
        raise InputError(f"{path.name} is empty (0 bytes): expected a scan; copy it again")
    for item in FORMATS:
        if item.signature is not None and item.signature.match(start):
            return item
    named = next((item for item in FORMATS if path.suffix.lower() in item.suffixes), None)
    if named is None:
        known = " ".join(suffix for item in FORMATS for suffix in item.suffixes)
        raise InputError(
            f"{path.name} is not a point file that orthoflow reads: expected one of {known}"
        )
    if named.beginning or (named is PCD and b"\0" in start[:64]):
        raise InputError(
            f"{path.name} has the suffix of {named.name} files but does not begin with "
            f"{named.beginning or '# .PCD'!r}: the file is damaged or has another format; export "
            "it again or correct its suffix"
        )
    return named


def open_scan(
    path: Path,
    columns: Columns | None = None,
    *,
    classes: Collection[int] = (),
    query: PointQuery | None = None,
    intensity_field: str | None = None,
) -> ScanFile:
    """Open a point file and read its header.

    Args:
        path: the file.
        columns: meaning of the columns of a text file, if given by the user.
        classes: classes of points to read from a LAS or LAZ file; empty for all classes.
        query: requested points; a COPC file is read only where it has such points, other files
            are read completely.
        intensity_field: name of the field to use as intensity; None for the usual one.

    Raises:
        InputError: the file cannot be read; the message gives the reason.
        PluginError: the library for this format is missing.
    """
    found = find_format(path)
    choice: dict[str, object] = {"intensity_field": intensity_field}
    if found is TEXT:
        choice["columns"] = columns
    if found is LAS:
        choice |= {"classes": classes, "query": query}
    module, function = found.reader
    scan: ScanFile = getattr(import_module(f"{__package__}.{module}"), function)(path, **choice)
    n_bytes = path.stat().st_size
    if scan.n_most > MOST_POINTS_PER_BYTE * n_bytes:
        raise InputError(
            f"{path.name} declares {scan.n_most} points, but its {n_bytes} bytes cannot contain "
            "them: the file is damaged or truncated; copy or export it again"
        )
    return scan
