"""Robust writing of HDF5 files when the disk is full, and safe opening of untrusted files.

After a write error, the HDF5 library cannot close the file: it keeps the file open, reports the
error again in destructors, and may crash the process at exit. HDF5 therefore writes to a file
object whose operations never fail. This object stores the first error, which is raised after HDF5
has closed the file.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.document import (
    FORMAT_VERSION,
    LockedFileError,
    RecordFormatError,
    UnknownFormatError,
)
from orthoflow_provenance.paths import check_name

# Exceptions that h5py may raise for damaged files; the type depends on the position of the damage.
HDF5_ERRORS: Final = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    IndexError,
    AttributeError,
    OverflowError,
    MemoryError,
    SystemError,
)
# This version of the file format can be read by HDF5 1.10 and newer. Its internal structures have
# checksums.
_LIBRARY_VERSIONS: Final = (h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
# Arrays that are large enough for memory mapping start at a multiple of this offset, so that they
# are aligned.
_ALIGNMENT_BYTES: Final = 64
_ALIGNED_FROM_BYTES: Final = 2048
# After a write error, larger blocks (data) are discarded, but smaller blocks are kept in memory,
# because HDF5 must be able to read its internal structures again.
_KEPT_AFTER_FAILURE_BYTES: Final = 64 << 10

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
# Size of superblocks of versions 2 and 3, and the flags that mark a file as open for writing.
_SUPERBLOCK_BYTES: Final = 36
_WRITER_MARKS: Final = 0b101
_DEEPEST: Final = 32
# Maximum ratio of declared to stored bytes in valid files: deflate compresses by a factor of at
# most 1032.
_LARGEST_RATIO: Final = 1100
_LARGEST_CHUNK_BYTES: Final = 64 << 20
_LARGEST_ATTRIBUTE_BYTES: Final = 1 << 20
_LONGEST_NAME: Final = 256
# Maximum size of compressed strings, tables and figures; larger ones could expand too much.
_PACKED_BYTES_MOST: Final = 4 << 20
# A cell with its products has about 50. Section 2 of `provenance/SPEC.md` lists other limits.
#: groups, datasets and attributes of a record
MAX_OBJECTS: Final = 1_000_000
_FILTERS: Final = {
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
}
_PLAIN_CLASSES: Final = frozenset({h5py.h5t.INTEGER, h5py.h5t.FLOAT})


@contextmanager
def reading(place: str) -> Iterator[None]:
    """Convert HDF5 errors that occur while an object is read to errors that name the object.

    Raises:
        RecordFormatError: reading failed.
    """
    try:
        yield
    except RecordFormatError:
        raise
    except HDF5_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordFormatError(
            f"{place} cannot be read because the file is damaged: {reason}"
        ) from error


def fixed_text(text: str) -> NDArray[np.bytes_]:
    """Return a string as stored in HDF5: fixed-length UTF-8, without NUL and unpaired surrogates.

    Variable-length strings would be stored in the global heap, the only HDF5 structure without a
    checksum, where a single changed byte can make the library loop forever.
    """
    data = text.replace("\0", "").encode("utf-8", "replace")
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))


def set_attributes(item: h5py.Group | h5py.Dataset, **values: str | float) -> None:
    """Write scalar attributes: fixed-length strings, integers as int64, others as float64."""
    for name, value in values.items():
        item.attrs[name] = attribute_value(value)


def attribute_value(value: str | float) -> NDArray[np.generic]:
    """Return the value of an attribute as it is stored."""
    if isinstance(value, str):
        return fixed_text(value)
    return np.array(value, dtype="<i8" if isinstance(value, int) else "<f8")


def text_attribute(item: h5py.Group | h5py.Dataset, name: str) -> str:
    """Read an attribute that is a string.

    Raises:
        RecordFormatError: the attribute is missing or not a string.
    """
    value = _attribute(item, name)
    if not isinstance(value, bytes):
        raise RecordFormatError(f"{item.name}@{name} must be text, got {type(value).__name__}")
    return _decoded(bytes(value), f"{item.name}@{name}")


def int_attribute(item: h5py.Group | h5py.Dataset, name: str) -> int:
    """Read an integer attribute.

    Raises:
        RecordFormatError: the attribute is missing or not an integer.
    """
    value = _attribute(item, name)
    if not isinstance(value, np.integer | int):
        raise RecordFormatError(
            f"{item.name}@{name} must be an integer, got {type(value).__name__}"
        )
    return int(value)


def write_array(group: h5py.Group, name: str, data: NDArray[np.generic]) -> h5py.Dataset:
    """Write a string, a table or bytes as a contiguous dataset without timestamps."""
    return group.create_dataset(name, data=data, track_times=False)


def read_text(group: h5py.Group, name: str) -> str:
    """Read a dataset that is a string.

    Raises:
        RecordFormatError: the dataset is missing, damaged or not a string.
    """
    dataset = dataset_of(group, name)
    value = read_whole(dataset)
    if not isinstance(value, bytes):
        raise RecordFormatError(f"{dataset.name} must be a single string, got {dataset.dtype}")
    return _decoded(bytes(value), dataset.name)


def open_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Open a subgroup.

    Raises:
        RecordFormatError: there is no group with this name.
    """
    return _child(parent, name, h5py.Group, "group")


def dataset_of(group: h5py.Group, name: str) -> h5py.Dataset:
    """Open a dataset.

    Raises:
        RecordFormatError: there is no dataset with this name.
    """
    return _child(group, name, h5py.Dataset, "dataset")


# The type is Any, because h5py has no type annotations.
def _child(parent: h5py.Group, name: str, kind: type, what: str) -> Any:
    with reading(f"{parent.name.rstrip('/')}/{name}"):
        found = parent.get(name)
    if not isinstance(found, kind):
        raise RecordFormatError(f"{parent.name} lacks the {what} {name}")
    return found


def read_whole(dataset: h5py.Dataset) -> object:
    """Read all data of a dataset with a string, a table or a figure.

    Raises:
        RecordFormatError: the dataset is damaged, or is compressed although it is large.
    """
    with reading(dataset.name):
        if dataset.nbytes > max(_PACKED_BYTES_MOST, dataset.id.get_storage_size()):
            raise RecordFormatError(
                f"{dataset.name} has {dataset.nbytes} bytes when decompressed: "
                f"strings, tables and figures of more than {_PACKED_BYTES_MOST} bytes must "
                "not be compressed"
            )
        value: object = dataset[()]
    return value


# Files whose objects this process has checked: device, number, size, times of the last change.
_CHECKED: Final[set[tuple[int, ...]]] = set()
# A file that was changed a moment ago may change again without getting another time.
_RECENT_NS: Final = 2_000_000_000


class FileSink:
    """A file object for HDF5 whose write operations never raise an error.

    Attributes:
        failure: the first error that the operating system reported; None if there was none.
    """

    def __init__(self, path: Path) -> None:
        # Do not follow links, because this would truncate the target, which is another file.
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        # Offsets and bytes of the blocks that were not written because of an error, in order.
        self._kept: list[tuple[int, bytes]] = []
        self.failure: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, and return it; HDF5 also uses this function to determine the size."""
        if whence == os.SEEK_END:
            ends = (start + len(data) for start, data in self._kept)
            offset += max(os.fstat(self._descriptor).st_size, *ends, 0)
            whence = os.SEEK_SET
        return os.lseek(self._descriptor, offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self.seek(0, os.SEEK_CUR)

    def write(self, data: memoryview) -> int:
        """Write all data at the position."""
        view = memoryview(data).cast("B")
        start, done = self.tell(), 0
        try:
            while self.failure is None and done < len(view):
                done += os.write(self._descriptor, view[done:])
        except OSError as error:
            self.failure = error
        if self.failure is not None and len(view) <= _KEPT_AFTER_FAILURE_BYTES:
            self._kept.append((start, bytes(view)))
        self.seek(start + len(view))
        return len(view)

    def readinto(self, buffer: memoryview) -> int:
        """Read at the position; bytes beyond the end of the file are zero."""
        view = memoryview(buffer).cast("B")
        position = self.tell()
        stored = os.read(self._descriptor, len(view))
        view[: len(stored)] = stored
        view[len(stored) :] = bytes(len(view) - len(stored))
        for offset, data in self._kept:
            start, stop = max(offset, position), min(offset + len(data), position + len(view))
            if start < stop:
                view[start - position : stop - position] = data[start - offset : stop - offset]
        self.seek(position + len(view))
        return len(view)

    def truncate(self, size: int) -> int:
        """Set the length of the file."""
        try:
            if self.failure is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.failure = error
        return size

    def flush(self) -> None:
        """Do nothing, because `close` syncs the data to disk."""

    def close(self) -> None:
        """Sync the data to disk and close the file.

        Raises:
            OSError: this or an earlier operation failed.
        """
        try:
            if self.failure is None:
                os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
        if self.failure is not None:
            raise self.failure


@contextmanager
def create_file(path: Path) -> Iterator[h5py.File]:
    """Create an HDF5 file, and sync it to disk on closing; an existing file is overwritten.

    If an error occurs, the incomplete file is removed.

    Raises:
        OSError: the file cannot be created or written, for example because the disk is full.
    """
    sink = FileSink(path)
    try:
        try:
            file = _open_through(sink, path)
            try:
                yield file
            finally:
                file.close()
        finally:
            # Raise the first error of the operating system instead of the HDF5 errors that it
            # caused.
            sink.close()
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def create_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Create a group without timestamps, so that equal content gives equal files."""
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_obj_track_times(False)
    return h5py.Group(h5py.h5g.create(parent.id, name.encode("utf-8"), gcpl=properties))


@contextmanager
def safe_open(path: Path, format_name: str) -> Iterator[h5py.File]:
    """Open a file with a given format for reading, after checking all objects in it.

    A file that this process has checked is not checked again until it changes.

    Raises:
        UnknownFormatError: the file is not an HDF5 file, or it has another format or another
            version of the format.
        LockedFileError: the file is open for writing in another process, or was not closed because
            of a crash.
        RecordFormatError: the file is damaged or contains something that the format does not allow:
            links other than hard links, objects with two paths or an invalid name, external or
            virtual storage, filters other than shuffle, gzip and fletcher32, other data types, or
            datasets that expand to far more than the file could contain.
        OSError: the file cannot be opened.
    """
    _check_superblock(path)
    with reading(path.name):
        file = h5py.File(path, "r", locking=False)
    try:
        _require_format(file, path.name, format_name)
        state = os.fstat(file.id.get_vfd_handle())
        times_ns = state.st_mtime_ns, state.st_ctime_ns
        identity = (state.st_dev, state.st_ino, state.st_size, *times_ns)
        if identity not in _CHECKED:
            _Inspection(file, path).run()
            if time.time_ns() - max(times_ns) > _RECENT_NS:
                _CHECKED.add(identity)
        yield file
    finally:
        file.close()


def _check_superblock(path: Path) -> None:
    with path.open("rb") as stream:
        start = stream.read(_SUPERBLOCK_BYTES)
    if not start.startswith(_SIGNATURE):
        raise UnknownFormatError(
            f"{path.name} is not an HDF5 file: its first bytes are not those of HDF5"
        )
    if len(start) == _SUPERBLOCK_BYTES and start[8] == 3 and start[11] & _WRITER_MARKS:
        raise LockedFileError(
            f"{path.name} is marked as open for writing: close the program that has it open; if a "
            f"program crashed and left the mark, remove it with `h5clear -s {path.name}` (part of "
            "the HDF5 tools), and check with `orthoflow verify` whether the file is complete"
        )


def bytes_behind_end(path: Path) -> int:
    """Return the number of bytes after the end of the HDF5 data; negative if bytes are missing."""
    with path.open("rb") as stream:
        start = stream.read(_SUPERBLOCK_BYTES)
    return path.stat().st_size - int.from_bytes(start[28:36], "little")


def _require_format(file: h5py.File, file_name: str, name: str) -> None:
    with reading(file_name):
        found, version = (_short_text(file, one) for one in ("format", "format_version"))
    if found is None or version is None:
        raise UnknownFormatError(
            f"{file_name} is not an orthoflow record: it declares no format or version; "
            "give a run.h5"
        )
    if found != name:
        raise UnknownFormatError(f"{file_name} must have the format {name}, got {found!r}")
    if version != FORMAT_VERSION:
        raise UnknownFormatError(
            f"{file_name} has format version {version!r}, but this program reads version "
            f"{FORMAT_VERSION}: use the version of orthoflow that wrote it, or a newer one"
        )


def _short_text(file: h5py.File, name: str) -> str | None:
    """Read an attribute of an unchecked file; None unless it is a short fixed-length string."""
    if not h5py.h5a.exists(file.id, name.encode()):
        return None
    attribute = h5py.h5a.open(file.id, name.encode())
    kind = attribute.get_type()
    is_text = kind.get_class() == h5py.h5t.STRING and _is_plain(kind) and attribute.shape == ()
    return text_attribute(file, name) if is_text and kind.get_size() <= _LONGEST_NAME else None


class _Inspection:
    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file = file
        self._name = path.name
        self._n_objects = 0
        self._seen: set[tuple[int, int]] = set()

    def run(self) -> None:
        """Inspect all objects of the file.

        Raises:
            RecordFormatError: an object is not allowed.
        """
        # Use low-level identifiers, because h5py's high-level objects take three times as long.
        pending: list[tuple[h5py.h5g.GroupID, str, int]] = [(self._file.id, "/", 0)]
        self._visit_once(self._file.id, "/")
        while pending:
            group, path, depth = pending.pop()
            too_deep = f"is nested in more than {_DEEPEST} groups"
            self._refuse(path, depth > _DEEPEST, too_deep)
            with reading(f"{self._name}:{path}"):
                self._check_attributes(group, path)
                names = list(group)
            for name in names:
                place = f"{path.rstrip('/')}/{name.decode('utf-8', 'backslashreplace')}"
                with reading(f"{self._name}:{place}"):
                    child = self._open(group, name, place)
                    if isinstance(child, h5py.h5g.GroupID):
                        pending.append((child, place, depth + 1))
                    else:
                        self._check_attributes(child, place)
                        self._check_dataset(child, place)

    def _open(
        self, group: h5py.h5g.GroupID, name: bytes, place: str
    ) -> h5py.h5g.GroupID | h5py.h5d.DatasetID:
        try:
            # Reject names such as `..`, which other programs would interpret as the parent group.
            check_name(name.decode("utf-8"), "the object")
        except RecordFormatError as error:
            raise self._refusal(place, f"is not a valid path in a record: {error}") from error
        link = group.links.get_info(name).type
        self._refuse(place, link == h5py.h5l.TYPE_EXTERNAL, "is a link into another file")
        is_soft = link != h5py.h5l.TYPE_HARD
        self._refuse(place, is_soft, "is a soft link; only hard links are allowed")
        child = h5py.h5o.open(group, name)
        is_known = isinstance(child, h5py.h5g.GroupID | h5py.h5d.DatasetID)
        self._refuse(place, not is_known, "is neither a group nor a dataset")
        self._visit_once(child, place)
        return child

    def _visit_once(self, item: h5py.h5g.GroupID | h5py.h5d.DatasetID, place: str) -> None:
        # If objects could have several paths, a few bytes could describe loops, and trees of any
        # size.
        info = h5py.h5o.get_info(item)
        identity = (int(info.fileno), int(info.addr))
        is_known = identity in self._seen
        self._refuse(place, is_known, "refers to an object that also has another path")
        self._seen.add(identity)
        self._count(1, place)

    def _count(self, n_objects: int, place: str) -> None:
        self._n_objects += n_objects
        reason = f"exceeds the limit of {MAX_OBJECTS} groups, datasets and attributes in a file"
        self._refuse(place, self._n_objects > MAX_OBJECTS, reason)

    def _check_dataset(self, dataset: h5py.h5d.DatasetID, place: str) -> None:
        properties, kind = dataset.get_create_plist(), dataset.get_type()
        layout = properties.get_layout()
        is_chunked, itemsize = layout == h5py.h5d.CHUNKED, kind.get_size()
        used = [properties.get_filter(index)[0] for index in range(properties.get_nfilters())]
        is_filtered = not set(used) <= set(_FILTERS) or len(set(used)) != len(used)
        chunk = math.prod(properties.get_chunk()) * itemsize if is_chunked else 0
        in_file = is_chunked or layout in {h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS}
        filters = (
            f"must use no filters other than {', '.join(_FILTERS.values())}, and each at most once"
        )
        self._refuse(place, properties.get_external_count(), "stores its data in another file")
        self._refuse(place, not in_file, "is a virtual dataset")
        self._refuse(place, is_filtered, filters)
        self._refuse(place, not _is_allowed(kind), "has a type outside the format")
        self._refuse(place, chunk > _LARGEST_CHUNK_BYTES, "has chunks of more than 64 MiB")
        declared = math.prod(dataset.shape or ()) * itemsize
        stored = dataset.get_storage_size()
        sizes = f"declares {declared} bytes, but the file contains {stored}"
        self._refuse(place, declared > _LARGEST_RATIO * stored, sizes)

    def _check_attributes(self, item: h5py.h5g.GroupID | h5py.h5d.DatasetID, place: str) -> None:
        n_attributes = h5py.h5a.get_num_attrs(item)
        self._count(n_attributes, place)
        for index in range(n_attributes):
            attribute = h5py.h5a.open(item, index=index)
            kind, where = attribute.get_type(), place
            where += "@" + attribute.name.decode("utf-8", "backslashreplace")
            self._refuse(where, not _is_allowed(kind), "has a type outside the format")
            n_bytes = math.prod(attribute.shape) * kind.get_size()
            self._refuse(where, n_bytes > _LARGEST_ATTRIBUTE_BYTES, "is larger than 1 MiB")

    def _refuse(self, place: str, is_wrong: object, reason: str) -> None:
        if is_wrong:
            raise self._refusal(place, reason)

    def _refusal(self, place: str, reason: str) -> RecordFormatError:
        return RecordFormatError(f"{self._name}:{place} {reason}: the file is not opened")


def _is_allowed(kind: h5py.h5t.TypeID) -> bool:
    """Return whether a type is allowed: numbers, bool, fixed-length strings, and rows of these."""
    type_class = kind.get_class()
    if type_class == h5py.h5t.COMPOUND:
        return all(_is_plain(kind.get_member_type(index)) for index in range(kind.get_nmembers()))
    return _is_plain(kind)


def _is_plain(kind: h5py.h5t.TypeID) -> bool:
    type_class = kind.get_class()
    if type_class == h5py.h5t.STRING:
        return not kind.is_variable_str()
    return type_class in _PLAIN_CLASSES or type_class == h5py.h5t.ENUM


def _open_through(sink: FileSink, path: Path) -> h5py.File:
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    access.set_libver_bounds(*_LIBRARY_VERSIONS)
    access.set_alignment(_ALIGNED_FROM_BYTES, _ALIGNMENT_BYTES)
    access.set_fileobj_driver(h5py.h5fd.fileobj_driver, sink)
    creation = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    name = os.fsencode(path)
    return h5py.File(h5py.h5f.create(name, h5py.h5f.ACC_TRUNC, fapl=access, fcpl=creation))


def _attribute(item: h5py.Group | h5py.Dataset, name: str) -> object:
    with reading(f"{item.name}@{name}"):
        value: object = item.attrs.get(name)
    if value is None:
        raise RecordFormatError(f"{item.name} lacks the attribute {name}")
    return value


def _decoded(data: bytes, place: str) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise RecordFormatError(f"{place} must be UTF-8 text: {error}") from error
