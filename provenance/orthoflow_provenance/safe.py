"""Opening files from strangers: nothing outside the file is read, nothing small becomes huge."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import h5py

from orthoflow_provenance.encoding import HDF5_ERRORS, check_name, reading, text_attribute
from orthoflow_provenance.errors import ForeignFormatError, RecordFormatError
from orthoflow_provenance.model import (
    PRODUCT_FORMAT,
    PRODUCT_FORMAT_VERSION,
    RUN_FORMAT,
    RUN_FORMAT_VERSION,
)

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_DEEPEST: Final = 32
# No honest file comes near: deflate packs at most 1032 to 1.
_LARGEST_RATIO: Final = 1100
_ALWAYS_ALLOWED_BYTES: Final = 64 << 20
_LARGEST_CHUNK_BYTES: Final = 64 << 20
_LARGEST_ATTRIBUTE_BYTES: Final = 1 << 20
_LONGEST_FORMAT_BYTES: Final = 256
# Groups, datasets and attributes; a cell with its products has some fifty.
MOST_OBJECTS: Final = 1_000_000
_FILTERS: Final = {
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
}
_PLAIN_CLASSES: Final = frozenset({h5py.h5t.INTEGER, h5py.h5t.FLOAT})


@contextmanager
def safe_open(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading after looking at every object in it.

    Raises:
        ForeignFormatError: the file is no HDF5 file, or something of the following is so because
            another program or a later version wrote it.
        RecordFormatError: the file is damaged, or holds links other than hard
            links, an object that is reached twice or has an impossible name, external or virtual
            storage, filters other than shuffle, gzip and fletcher32, types outside the format, or
            datasets that unpack to far more than the file could hold.
        OSError: the file cannot be opened.
    """
    _check_signature(path)
    with reading(path.name):
        file = h5py.File(path, "r", locking=False)
    try:
        try:
            _Inspection(file, path).run()
        except RecordFormatError as error:
            # What a file is comes before what is forbidden in it.
            raise _foreign(file) or error from error
        yield file
    finally:
        file.close()


def _check_signature(path: Path) -> None:
    with path.open("rb") as stream:
        start = stream.read(len(_SIGNATURE))
    if start != _SIGNATURE:
        raise ForeignFormatError(f"{path.name} must be an HDF5 file, but does not begin like one")


def check_format(file: h5py.File, name: str, version: str) -> None:
    """Refuse files of another format, or of a later major version of this one.

    Raises:
        ForeignFormatError: the file is such a one.
        RecordFormatError: its version is like no other.
    """
    file_name = Path(file.filename).name
    try:
        found, found_version = (
            text_attribute(file, "format"),
            text_attribute(file, "format_version"),
        )
    except RecordFormatError as error:
        raise ForeignFormatError(
            f"{file_name} must be of format {name}, but it names no format: it was not written by "
            "orthoflow, or it is damaged"
        ) from error
    if found != name:
        raise ForeignFormatError(f"{file_name} must be of format {name}, got {found!r}")
    major, _, minor = found_version.partition(".")
    if not (major.isascii() and major.isdigit() and minor.isascii() and minor.isdigit()):
        raise RecordFormatError(f"{file_name} has a format version {found_version!r} like no other")
    if int(major) != int(version.partition(".")[0]):
        raise ForeignFormatError(
            f"{file_name} has format version {found_version}, this program reads version "
            f"{version}: use a newer orthoflow"
        )


def _foreign(file: h5py.File) -> ForeignFormatError | None:
    """Say of a refused file that it is of another program or version; None of one of ours."""
    try:
        if not all(_is_short_text(file, name) for name in (b"format", b"format_version")):
            name = Path(file.filename).name
            return ForeignFormatError(
                f"{name} is no record of orthoflow: it does not name that format; give a run.h5"
            )
        if text_attribute(file, "format") == PRODUCT_FORMAT:
            check_format(file, PRODUCT_FORMAT, PRODUCT_FORMAT_VERSION)
        else:
            check_format(file, RUN_FORMAT, RUN_FORMAT_VERSION)
    except ForeignFormatError as error:
        return error
    except (RecordFormatError, *HDF5_ERRORS):
        return None
    return None


def _is_short_text(file: h5py.File, name: bytes) -> bool:
    """Whether an attribute is text as records have it: of fixed length, so that it may be read."""
    if not h5py.h5a.exists(file.id, name):
        return False
    kind = h5py.h5a.open(file.id, name).get_type()
    return _is_text(kind) and _is_plain(kind) and kind.get_size() <= _LONGEST_FORMAT_BYTES


class _Inspection:
    """One walk over all links, objects and attributes of a file."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file = file
        self._name = path.name
        self._size_bytes = path.stat().st_size
        self._stored_bytes = 0
        self._n_objects = 0
        self._unfounded_bytes = 0
        self._seen: set[tuple[int, int]] = set()

    def run(self) -> None:
        """Look at everything, deepest last.

        Raises:
            RecordFormatError: something forbidden was found.
        """
        # Low-level identifiers: the objects of h5py on top of them would take three times as long.
        pending: list[tuple[h5py.h5g.GroupID, str, int]] = [(self._file.id, "/", 0)]
        self._visit_once(self._file.id, "/")
        while pending:
            group, path, depth = pending.pop()
            if depth > _DEEPEST:
                raise self._refusal(path, f"is nested more than {_DEEPEST} groups deep")
            with reading(f"{self._name}:{path}"):
                self._check_attributes(group, path)
                names = list(group)
            for name in names:
                place = f"{path.rstrip('/')}/{name.decode('utf-8', 'backslashreplace')}"
                with reading(f"{self._name}:{place}"):
                    self._check_name(name, place)
                    child = self._open(group, name, place)
                    if isinstance(child, h5py.h5g.GroupID):
                        pending.append((child, place, depth + 1))
                    else:
                        self._check_attributes(child, place)
                        self._check_dataset(child, place)

    def _open(
        self, group: h5py.h5g.GroupID, name: bytes, place: str
    ) -> h5py.h5g.GroupID | h5py.h5d.DatasetID:
        link = group.links.get_info(name).type
        if link == h5py.h5l.TYPE_EXTERNAL:
            raise self._refusal(place, "is a link into another file")
        if link != h5py.h5l.TYPE_HARD:
            raise self._refusal(place, "is a soft link, only hard links are allowed")
        child = h5py.h5o.open(group, name)
        if not isinstance(child, h5py.h5g.GroupID | h5py.h5d.DatasetID):
            raise self._refusal(place, "is neither a group nor a dataset")
        self._visit_once(child, place)
        return child

    def _check_name(self, name: bytes, place: str) -> None:
        # A way down is asked for with `/` between names: `..` would be one up for other programs.
        if not _is_note(place):
            try:
                check_name(name.decode("utf-8"), "the object")
            except RecordFormatError as error:
                raise self._refusal(place, f"is no place in a record: {error}") from error

    def _visit_once(self, item: h5py.h5g.GroupID | h5py.h5d.DatasetID, place: str) -> None:
        # Two ways to one object make loops, and trees that grow without end from a few bytes.
        info = h5py.h5o.get_info(item)
        identity = (int(info.fileno), int(info.addr))
        if identity in self._seen:
            raise self._refusal(place, "leads to an object that has another place as well")
        self._seen.add(identity)
        self._count(1, place)

    def _count(self, n_objects: int, place: str) -> None:
        self._n_objects += n_objects
        if self._n_objects > MOST_OBJECTS:
            raise self._refusal(
                place, f"and what lies before it are more than {MOST_OBJECTS} groups and attributes"
            )

    def _check_dataset(self, dataset: h5py.h5d.DatasetID, place: str) -> None:
        properties = dataset.get_create_plist()
        if properties.get_external_count():
            raise self._refusal(place, "keeps its data in another file")
        layout = properties.get_layout()
        if layout not in {h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED}:
            raise self._refusal(place, "is a virtual dataset")
        used = [properties.get_filter(index)[0] for index in range(properties.get_nfilters())]
        if not set(used) <= set(_FILTERS) or len(set(used)) != len(used):
            raise self._refusal(
                place, f"must use each of {', '.join(_FILTERS.values())} at most once and no other"
            )
        kind = dataset.get_type()
        if not (_is_allowed(kind) or (_is_note(place) and _is_text(kind))):
            raise self._refusal(place, "has a type outside the format")
        if layout == h5py.h5d.CHUNKED and (
            math.prod(properties.get_chunk()) * kind.get_size() > _LARGEST_CHUNK_BYTES
        ):
            raise self._refusal(place, "has chunks of more than 64 MiB")
        self._check_size(dataset, kind.get_size(), place)

    def _check_size(self, dataset: h5py.h5d.DatasetID, itemsize: int, place: str) -> None:
        declared = math.prod(dataset.shape or ()) * itemsize
        stored = dataset.get_storage_size()
        if declared > max(_ALWAYS_ALLOWED_BYTES, _LARGEST_RATIO * stored):
            raise self._refusal(
                place, f"says it has {declared} bytes, but the file holds {stored} for it"
            )
        # Many that each stay below what is always allowed would be a flood together.
        self._unfounded_bytes += max(0, declared - _LARGEST_RATIO * stored)
        if self._unfounded_bytes > _ALWAYS_ALLOWED_BYTES:
            raise self._refusal(
                place,
                "and those before it say they have more than 64 MiB that the file cannot hold",
            )
        self._stored_bytes += stored
        if self._stored_bytes > self._size_bytes:
            raise self._refusal(place, "and the datasets before it say more than the file can hold")

    def _check_attributes(self, item: h5py.h5g.GroupID | h5py.h5d.DatasetID, place: str) -> None:
        n_attributes = h5py.h5a.get_num_attrs(item)
        self._count(n_attributes, place)
        for index in range(n_attributes):
            attribute = h5py.h5a.open(item, index=index)
            kind = attribute.get_type()
            problem = ""
            if not (_is_allowed(kind) or (_is_note(place) and _is_text(kind))):
                problem = "has a type outside the format"
            elif math.prod(attribute.shape) * kind.get_size() > _LARGEST_ATTRIBUTE_BYTES:
                problem = "is larger than 1 MiB"
            if problem:
                name = attribute.name.decode("utf-8", "backslashreplace")
                raise self._refusal(f"{place}@{name}", problem)

    def _refusal(self, place: str, reason: str) -> RecordFormatError:
        return RecordFormatError(f"{self._name}:{place} {reason}: the file is not opened")


def _is_note(place: str) -> bool:
    # Notes are never read here, so people may write them as h5py does by itself: text of variable
    # length, which elsewhere could unpack to any size.
    return place.startswith("/notes/") or place == "/notes"


def _is_text(kind: h5py.h5t.TypeID) -> bool:
    return bool(kind.get_class() == h5py.h5t.STRING)


def _is_allowed(kind: h5py.h5t.TypeID) -> bool:
    """Say whether values of a type lie in the dataset itself: numbers, bool, fixed text, rows."""
    type_class = kind.get_class()
    if type_class == h5py.h5t.COMPOUND:
        return all(_is_plain(kind.get_member_type(index)) for index in range(kind.get_nmembers()))
    return _is_plain(kind)


def _is_plain(kind: h5py.h5t.TypeID) -> bool:
    type_class = kind.get_class()
    if type_class == h5py.h5t.STRING:
        return not kind.is_variable_str()
    return type_class in _PLAIN_CLASSES or type_class == h5py.h5t.ENUM
