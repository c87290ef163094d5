"""Which reader a point file needs, told by its content and its suffix."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import MOST_POINTS_PER_BYTE, ScanFile
from orthoflow.files.points.columns import Columns
from orthoflow.files.points.copc import Wish


@dataclass(frozen=True, kw_only=True)
class Format:
    """One family of point files.

    Attributes:
        name: as people call it.
        suffixes: lower case, with the dot.
        signatures: what its files begin with; empty for plain text.
    """

    name: str
    suffixes: tuple[str, ...]
    signatures: tuple[bytes, ...] = ()


E57: Final = Format(name="E57", suffixes=(".e57",), signatures=(b"ASTM-E57",))
LAS: Final = Format(name="LAS/LAZ", suffixes=(".las", ".laz"), signatures=(b"LASF",))
PLY: Final = Format(name="PLY", suffixes=(".ply",), signatures=(b"ply\n", b"ply\r"))
PCD: Final = Format(name="PCD", suffixes=(".pcd",), signatures=(b"# .PCD", b"VERSION", b"FIELDS "))
PTX: Final = Format(name="PTX", suffixes=(".ptx",))
TEXT: Final = Format(name="text", suffixes=(".xyz", ".txt", ".csv", ".asc", ".pts"))
FORMATS: Final = (E57, LAS, PLY, PCD, PTX, TEXT)


def find_format(path: Path) -> Format:
    """Format of a point file: by its content where that is certain, else by its suffix.

    Raises:
        InputError: the file is missing, empty, not what its suffix says, or of no known format.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path.name} must be a point file, but there is {found} at that place")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise InputError(f"{path.name} cannot be opened: {error.strerror}") from error
    if not start:
        raise InputError(f"{path.name} is empty (0 bytes): expected a scan; copy it again")
    for item in FORMATS:
        if start.startswith(item.signatures) and item.signatures:
            return item
    suffix = path.suffix.lower()
    named = next((item for item in FORMATS if suffix in item.suffixes), None)
    if named is None:
        known = " ".join(suffix for item in FORMATS for suffix in item.suffixes)
        raise InputError(
            f"{path.name} is no point file that orthoflow reads: expected one of {known}"
        )
    if named.signatures:
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
    cores: int = 1,
    wish: Wish | None = None,
) -> ScanFile:
    """Open a point file as far as its header.

    Args:
        path: the file.
        columns: what the columns of a text file are, if the user says so.
        classes: of a LAS or LAZ file only points of these classes are given; all when empty.
        cores: processes that may decode points; only large LAZ files use more than one.
        wish: of a COPC file only parts are read that hold such points; others are read whole.

    Raises:
        InputError: the file cannot be read, says what and why in one sentence.
        PluginError: the library for this format is missing.
    """
    scan = _opened(path, columns, classes=classes, cores=cores, wish=wish)
    n_bytes = path.stat().st_size
    if scan.n_most > MOST_POINTS_PER_BYTE * n_bytes:
        raise InputError(
            f"{path.name} states {scan.n_most} points but has {n_bytes} bytes, which cannot hold "
            "them: the file is damaged or cut off, copy or export it again"
        )
    return scan


def _opened(
    path: Path,
    columns: Columns | None,
    *,
    classes: Collection[int],
    cores: int,
    wish: Wish | None,
) -> ScanFile:
    found = find_format(path)
    if found is TEXT:
        from orthoflow.files.points.text import open_text

        return open_text(path, columns)
    if found is LAS:
        from orthoflow.files.points.las import open_las

        return open_las(path, classes=classes, cores=cores, wish=wish)
    return _openers()[found.name](path)


def _openers() -> Mapping[str, Callable[[Path], ScanFile]]:
    from orthoflow.files.points.e57 import open_e57
    from orthoflow.files.points.pcd import open_pcd
    from orthoflow.files.points.ply import open_ply
    from orthoflow.files.points.ptx import open_ptx

    return {
        E57.name: open_e57,
        PLY.name: open_ply,
        PCD.name: open_pcd,
        PTX.name: open_ptx,
    }
