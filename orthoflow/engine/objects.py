"""An object of the store: a folder with a product or a figure, and detection of damage.

A figure's folder is named by the SHA-256 of its bytes. A product's is named by the digest of its
content, which does not cover the bytes of its files: `object.json` does, and begins with the digest
of its own text.
"""

from __future__ import annotations

import errno
import json
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, Literal

from pydantic import TypeAdapter

from orthoflow.engine.durability import is_checked, with_digest, write_whole
from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.results import name_problem
from orthoflow.errors import ProductError

PRODUCT: Final = "product.h5"
PUBLISHED: Final = "files"
BLOB: Final = "blob"
DESCRIPTION: Final = "object.json"
# The missing part if nothing of an object exists.
WHOLE: Final = "whole object"
# The machine lacks a resource: that does not mean damage.
SHORTAGES: Final = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


@dataclass(frozen=True, kw_only=True)
class ObjectFile:
    """A file of an object as it was stored."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class StoredProduct:
    """The content of a product's `object.json`.

    Attributes:
        object: name of its folder.
        type: product type.
        publisher: version of what wrote the published files.
        files: path in the folder -> file; `object.json` is not among them.
    """

    format: Literal["orthoflow/object/1"] = "orthoflow/object/1"
    object: str
    type: str
    publisher: str
    files: Mapping[str, ObjectFile]


class CheckedFiles:
    """The files that a process found intact; unchanged ones need not be checked again."""

    def __init__(self) -> None:
        self._identities: dict[Path, tuple[int, ...]] = {}

    def trust(self, path: Path) -> None:
        """Mark a file as intact in its present state."""
        self._identities[path] = _identity(path)

    def forget(self, path: Path) -> None:
        """Check again next time, for damage that does not change time and size."""
        self._identities.pop(path, None)

    def is_sound(self, path: Path, expected: ObjectFile) -> bool:
        """Whether a file is a regular one with the expected bytes.

        Raises:
            OSError: the machine lacks memory or open files; what fails else is damage.
        """
        try:
            identity = _identity(path)
            if self._identities.get(path) == identity:
                return True
            is_sound = _has_size(path, expected) and file_sha256(path) == expected.sha256
        except OSError as error:
            if error.errno in SHORTAGES:
                raise
            return False
        if is_sound:
            self._identities[path] = identity
        return is_sound


def describe_product(folder: Path, name: str, type_name: str, publisher: str) -> None:
    """Write `object.json` for the files that lie in a folder.

    Raises:
        StoreError: the disk cannot be written.
        OSError: a file cannot be read.
    """
    published = sorted(path for path in (folder / PUBLISHED).rglob("*") if path.is_file())
    description = StoredProduct(
        object=name,
        type=type_name,
        publisher=publisher,
        files={
            path.relative_to(folder).as_posix(): ObjectFile(
                size_bytes=path.stat().st_size, sha256=file_sha256(path)
            )
            for path in (folder / PRODUCT, *published)
        },
    )
    text = json.dumps(_codec().dump_python(description, mode="json"))
    write_whole(folder / DESCRIPTION, with_digest(text).encode())


def require_plain_files(folder: Path, who: str) -> None:
    """Refuse what cannot be published: links, devices, and names that other systems do not allow.

    Raises:
        ProductError: the folder contains something of that kind.
    """
    for path in folder.rglob("*"):
        problem = name_problem(path.name)
        if path.is_symlink() or not (problem or path.is_file() or path.is_dir()):
            problem = "is a link or a device"
        if problem:
            raise ProductError(f"{who} publishes {path.name!r}, which {problem}")


def read_description(folder: Path) -> StoredProduct | None:
    """Read `object.json`; None if it is damaged, belongs to another object, or is missing.

    Raises:
        OSError: the machine lacks memory or open files.
    """
    try:
        text = (folder / DESCRIPTION).read_text(encoding="utf-8")
        found = _codec().validate_json(text, strict=True)
    except OSError as error:
        if error.errno in SHORTAGES:
            raise
        return None
    except ValueError:
        return None
    return found if is_checked(text) and found.object == folder.name else None


def files_of(folder: Path) -> Mapping[str, ObjectFile]:
    """Return the files that an object must have, by path in its folder; empty if unknown."""
    if folder.is_symlink():
        return {}
    if (folder / BLOB).exists():
        return {BLOB: ObjectFile(size_bytes=-1, sha256=folder.name)}
    found = read_description(folder)
    return found.files if found is not None else {}


def missing_part(folder: Path) -> str:
    """Part of an object that is missing or incomplete, by a quick check; empty if none."""
    files = files_of(folder)
    if not files:
        return part_name(DESCRIPTION) if folder.is_dir() else WHOLE
    for name, expected in files.items():
        try:
            is_there = _has_size(folder / name, expected)
        except OSError:
            is_there = False
        if not is_there:
            return part_name(name)
    return ""


def part_name(path: str) -> str:
    """Return the readable name of a file of an object."""
    names = {PRODUCT: "product file", BLOB: "figure", DESCRIPTION: "description"}
    return names.get(path) or f"published file {path.removeprefix(f'{PUBLISHED}/')}"


def _identity(path: Path) -> tuple[int, ...]:
    found = path.lstat()
    return (found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


def _has_size(path: Path, expected: ObjectFile) -> bool:
    found = path.lstat()
    return stat.S_ISREG(found.st_mode) and expected.size_bytes in (found.st_size, -1)


@cache
def _codec() -> TypeAdapter[StoredProduct]:
    return TypeAdapter(StoredProduct)
