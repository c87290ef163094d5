"""Choice of the reader of a point file, by its content and its suffix."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import MOST_POINTS_PER_BYTE, ScanFile
from orthoflow.files.points.copc import Wish
from orthoflow.files.points.fields import Columns


@dataclass(frozen=True, kw_only=True)
class Format:
    """One family of point files.

    Attributes:
        name: its usual name.
        suffixes: lower case, with the dot.
        signatures: first bytes of its files; empty for plain text.
    """

    name: str
    suffixes: tuple[str, ...]
    signatures: tuple[bytes, ...] = ()


E57: Final = Format(name="E57", suffixes=(".e57",), signatures=(b"ASTM-E57",))
LAS: Final = Format(name="LAS/LAZ", suffixes=(".las", ".laz"), signatures=(b"LASF",))
PLY: Final = Format(name="PLY", suffixes=(".ply",), signatures=(b"ply\n", b"ply\r", b"ply "))
PCD: Final = Format(name="PCD", suffixes=(".pcd",), signatures=(b"# .PCD",))
PTX: Final = Format(name="PTX", suffixes=(".ptx",))
TEXT: Final = Format(
    name="text",
    suffixes=(".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzi", ".xyzn", ".xyzrgb", ".tsv"),
)
_SNIFFED_BYTES: Final = 4096
_PCD_HEADER: Final = re.compile(rb"(?im)^[ \t]*(?:fields|columns)[ \t].*\n(?:.*\n)?[ \t]*size[ \t]")
FORMATS: Final = (E57, LAS, PLY, PCD, PTX, TEXT)


def find_format(path: Path) -> Format:
    """Return the format of a point file: by its content if that is certain, else by its suffix.

    Raises:
        InputError: the file is missing, empty, not what its suffix says, or of an unknown format.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path.name} must be a point file, but there is {found} at that place")
    try:
        with path.open("rb") as file:
            start = file.read(_SNIFFED_BYTES)
    except OSError as error:
        raise InputError(f"{path.name} cannot be opened: {error.strerror}") from error
    if not start:
        raise InputError(f"{path.name} is empty (0 bytes): expected a scan; copy it again")
    for item in FORMATS:
        if start.lower().startswith(tuple(s.lower() for s in item.signatures)) and item.signatures:
            return item
    # Programs write first lines of their own, or none.
    if _PCD_HEADER.search(start):
        return PCD
    suffix = path.suffix.lower()
    named = next((item for item in FORMATS if suffix in item.suffixes), None)
    if named is None:
        known = " ".join(suffix for item in FORMATS for suffix in item.suffixes)
        raise InputError(
            f"{path.name} is not a point file that orthoflow reads: expected one of {known}"
        )
    if named.signatures:
        if named is PCD and b"\0" not in start[:64]:
            return named
        expected = named.signatures[0].decode("ascii").strip()
        raise InputError(
            f"{path.name} is named as {named.name} but does not begin with {expected!r}: the file "
            "is damaged or of another format; export it again or give it its right suffix"
        )
    return named


def open_scan(
    path: Path,
    columns: Columns | None = None,
    *,
    classes: Collection[int] = (),
    wish: Wish | None = None,
    intensity_field: str | None = None,
) -> ScanFile:
    """Open a point file up to its header.

    Args:
        path: the file.
        columns: meaning of the columns of a text file, if the user states it.
        classes: of a LAS or LAZ file only points of these classes are read; all if empty.
        wish: of a COPC file only parts with such points are read; others are read completely.
        intensity_field: name of the field to use as the intensity; None for the usual one.

    Raises:
        InputError: the file cannot be read, with the reason in one sentence.
        PluginError: the library for this format is missing.
    """
    found = find_format(path)
    if found is TEXT:
        from orthoflow.files.points.text import open_text

        scan = open_text(path, columns, intensity_field=intensity_field)
    elif found is LAS:
        from orthoflow.files.points.las import open_las

        scan = open_las(path, classes=classes, wish=wish, intensity_field=intensity_field)
    else:
        module = import_module(f"orthoflow.files.points.{found.name.lower()}")
        scan = getattr(module, f"open_{found.name.lower()}")(path, intensity_field=intensity_field)
    n_bytes = path.stat().st_size
    if scan.n_most > MOST_POINTS_PER_BYTE * n_bytes:
        raise InputError(
            f"{path.name} states {scan.n_most} points but has {n_bytes} bytes, which cannot hold "
            "them: the file is damaged or cut off, copy or export it again"
        )
    return scan
