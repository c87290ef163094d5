"""Files of a run as what a record calls them, and nowhere but in their folder."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, Final

from orthoflow_provenance.document import (
    FIGURE_SUFFIXES,
    PublishedFile,
    RecordedFigure,
    UnsafeFileError,
)
from orthoflow_provenance.paths import (
    colliding,
    create_below,
    name_problem,
    open_below,
    path_below,
    path_problem,
)

from orthoflow.engine.durability import writing_to
from orthoflow.engine.journal import cell_file_name
from orthoflow.errors import RecordError, StoreError
from orthoflow.geometry.threads import in_order
from orthoflow.records.runs import Run

_ALWAYS_COPIED_BYTES: Final = 64 << 20


def path_inside(folder: Path, name: str) -> Path:
    """Make the path of a file that is called after something in a record.

    Raises:
        RecordError: no file can be called so.
    """
    try:
        return path_below(folder, name)
    except UnsafeFileError as error:
        raise RecordError(f"nothing is written to {folder}: {error}") from error


def figure_files(run: Run, addresses: Iterable[str]) -> Mapping[str, RecordedFigure]:
    """Name the files of the figures of cells: path below a folder -> figure.

    Raises:
        RecordError: a cell or a figure has a name or a type that no file can have.
    """
    named: list[tuple[str, RecordedFigure]] = []
    problems: list[str] = []
    for address in addresses:
        for figure in run.cells[address].figures:
            path = f"{cell_file_name(address)}/{figure.name}{_suffix(run, figure)}"
            named.append((path, figure))
            if said := name_problem(figure.name) or path_problem(path):
                problems.append(f"the figure {figure.name!r} of {address} {said}")
    if twice := colliding(path for path, _ in named):
        problems.append(f"two figures are named {twice!r}, as some systems see it")
    if problems:
        raise RecordError(f"{run.path}: {problems[0]}, so no file can be written for it")
    return dict(named)


def write_files(folder: Path, contents: Mapping[str, Callable[[], bytes | None]]) -> int:
    """Write files below a folder, through no link; a file of that name is replaced.

    Args:
        folder: made when missing.
        contents: path below it -> what gives the bytes, called in threads; None for no file.

    Returns:
        How many were written.

    Raises:
        StoreError: the disk refuses, or a link stands in the way.
    """
    with writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)

    def write(item: tuple[str, Callable[[], bytes | None]]) -> bool:
        path, content = item
        data = content()
        if data is None:
            return False
        with creating(folder, path) as stream:
            stream.write(data)
        return True

    return sum(in_order(write, contents.items()))


def copy_files(
    source: Path, target: Path, paths: Iterable[str], published: Iterable[PublishedFile]
) -> tuple[str, ...]:
    """Copy regular files that lie below one folder to below another.

    Args:
        source: the folder that they lie below.
        target: existing folder.
        paths: below both.
        published: what the record says of those that it names.

    Returns:
        Those that were there.

    Raises:
        RecordError: a link or a device stands in the place of a file, or it is not what the
            record says.
        StoreError: the disk refuses.
    """
    copied: list[str] = []
    known = {file.path: file for file in published}
    for path in paths:
        try:
            with open_below(source, path) as stream:
                expected = known.get(path)
                _check_size(source / path, os.fstat(stream.fileno()), expected)
                with creating(target, path) as copy:
                    shutil.copyfileobj(stream, copy, 1 << 20)
                    stream.seek(0)
                    _check_digest(source / path, stream, expected)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except UnsafeFileError as error:
            raise RecordError(f"{source}: {error}: only files of the run are copied") from error
        copied.append(path)
    return tuple(copied)


@contextmanager
def creating(folder: Path, path: str) -> Iterator[BinaryIO]:
    """Write one file below a folder; it gets its name when it is complete.

    Raises:
        StoreError: the disk refuses, or a link stands in the way.
    """
    try:
        with writing_to(folder), create_below(folder, path) as stream:
            yield stream
    except UnsafeFileError as error:
        raise StoreError(f"cannot write to {folder}: {error}") from error


def _check_digest(path: Path, stream: BufferedReader, expected: PublishedFile | None) -> None:
    if expected and hashlib.file_digest(stream, "sha256").hexdigest() != expected.sha256:
        raise RecordError(
            f"{path} was changed after the run: the record says that it has the digest "
            f"{expected.sha256}"
        )


def _check_size(path: Path, found: os.stat_result, expected: PublishedFile | None) -> None:
    if expected is not None and found.st_size != expected.size_bytes:
        raise RecordError(
            f"{path} has {found.st_size} bytes, but was published with {expected.size_bytes}: it "
            "was changed"
        )
    # A hole of a terabyte would fill the disk.
    if found.st_size > _ALWAYS_COPIED_BYTES and found.st_size > 8 * 512 * found.st_blocks:
        raise RecordError(f"{path} says it has {found.st_size} bytes, but most of it is a hole")


def _suffix(run: Run, figure: RecordedFigure) -> str:
    if figure.media_type not in FIGURE_SUFFIXES:
        raise RecordError(
            f"{run.path}: the figure {figure.name!r} must be {', '.join(FIGURE_SUFFIXES)}, got "
            f"{figure.media_type!r}"
        )
    # What papers and word processors take.
    shown = "image/png" if figure.media_type == "image/webp" else figure.media_type
    return FIGURE_SUFFIXES[shown]
