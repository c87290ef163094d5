"""How texts, attributes and flat tables lie in HDF5, and what becomes of HDF5's own errors."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.inner_files import holds_control
from orthoflow_provenance.model import JsonValue

# Everything that h5py raises for damaged files; which one depends on where the damage is.
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

# Nobody packs what is this small and read at once; more would be a flood from a few bytes.
_PACKED_BYTES_MOST: Final = 4 << 20

AttributeValue = str | int | float
Cell: TypeAlias = str | int | float
Kind: TypeAlias = type[str] | type[int] | type[float]
Columns: TypeAlias = Sequence[tuple[str, Kind]]


@contextmanager
def reading(place: str) -> Iterator[None]:
    """Turn whatever HDF5 says about a damaged place into one sentence.

    Raises:
        RecordFormatError: something inside failed.
    """
    try:
        yield
    except RecordFormatError:
        raise
    except HDF5_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordFormatError(f"{place} cannot be read, the file is damaged: {reason}") from error


def check_name(name: str, what: str) -> str:
    """Refuse names that cannot be one link in HDF5 or one line in the seal.

    Raises:
        RecordFormatError: the name is empty, `.` or `..`, or holds `/` or a control character.
    """
    if name in {"", ".", ".."} or "/" in name or holds_control(name):
        raise RecordFormatError(
            f"{what} {name!r} cannot be a name in a record: names are not empty, not `.` or `..`, "
            "and hold neither `/` nor control characters"
        )
    return name


def storable_text(text: str) -> str:
    """Drop NUL characters, which HDF5 text cannot hold, and replace halves of surrogate pairs."""
    return text.replace("\0", "").encode("utf-8", "replace").decode("utf-8")


def set_attributes(group: h5py.Group, values: Mapping[str, AttributeValue]) -> None:
    """Write scalar attributes: text as UTF-8, whole numbers as int64, others as float64.

    Text has a fixed length: text of variable length lies in HDF5's global heap, the one structure
    without a checksum, in which one changed byte can make the library loop for ever.
    """
    for name, value in values.items():
        if isinstance(value, str):
            group.attrs[name] = _fixed_text(value)
        elif isinstance(value, int):
            group.attrs[name] = np.int64(value)
        else:
            group.attrs[name] = np.float64(value)


def text_attribute(group: h5py.Group, name: str) -> str:
    """Read a text attribute.

    Raises:
        RecordFormatError: it is missing or not text.
    """
    value = _attribute(group, name)
    if not isinstance(value, bytes):
        raise _wrong_attribute(group, name, "text", value)
    return decoded(bytes(value), f"{group.name}@{name}")


def int_attribute(group: h5py.Group, name: str) -> int:
    """Read a whole-number attribute.

    Raises:
        RecordFormatError: it is missing or no whole number.
    """
    value = _attribute(group, name)
    if not isinstance(value, np.integer | int):
        raise _wrong_attribute(group, name, "a whole number", value)
    return int(value)


def float_attribute(group: h5py.Group, name: str) -> float:
    """Read a number attribute.

    Raises:
        RecordFormatError: it is missing or no number.
    """
    value = _attribute(group, name)
    if not isinstance(value, np.integer | np.floating | int | float):
        raise _wrong_attribute(group, name, "a number", value)
    return float(value)


def has_attribute(group: h5py.Group, name: str) -> bool:
    """Say whether a group has an attribute; those of later versions are missing in older files."""
    with reading(f"{group.name}@{name}"):
        return name in group.attrs


def write_text(group: h5py.Group, name: str, text: str) -> None:
    """Write a text of any length as a scalar UTF-8 dataset of fixed length."""
    group.create_dataset(name, data=_fixed_text(text), track_times=False)


def read_text(group: h5py.Group, name: str) -> str:
    """Read what `write_text` wrote.

    Raises:
        RecordFormatError: the dataset is missing, damaged or not text.
    """
    dataset = dataset_of(group, name)
    value = read_whole(dataset)
    if not isinstance(value, bytes):
        raise RecordFormatError(f"{group.name}/{name} must be one text, got {dataset.dtype}")
    return decoded(bytes(value), f"{group.name}/{name}")


def read_json(group: h5py.Group, name: str) -> dict[str, JsonValue]:
    """Read a text that holds a JSON object.

    Raises:
        RecordFormatError: the text is not one.
    """
    value = parse_json(read_text(group, name), f"{group.name}/{name}")
    if not isinstance(value, dict):
        raise RecordFormatError(f"{group.name}/{name} must hold a JSON object")
    return value


def parse_json(text: str, place: str) -> JsonValue:
    """Parse JSON as the format understands it: no NaN, no infinity, no endless nesting.

    Raises:
        RecordFormatError: the text is not such JSON.
    """

    def refuse(constant: str) -> JsonValue:
        raise ValueError(f"{constant} is no JSON")

    try:
        value: JsonValue = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise RecordFormatError(f"{place} must hold JSON: {error}") from error
    return value


def write_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> None:
    """Write a list of texts as a one-dimensional dataset."""
    write_table(group, name, (("text", str),), [(text,) for text in texts])


def read_texts(group: h5py.Group, name: str) -> tuple[str, ...]:
    """Read what `write_texts` wrote.

    Raises:
        RecordFormatError: the dataset is missing, damaged or no list of texts.
    """
    return tuple(str(row[0]) for row in read_table(group, name, (("text", str),)))


def write_table(
    group: h5py.Group, name: str, columns: Columns, rows: Sequence[Sequence[Cell]]
) -> None:
    """Write a flat table: one compound per row, text columns as wide as their longest text."""
    cells = [
        [storable_text(str(cell)).encode("utf-8") if kind is str else cell for cell in column]
        for column, (_, kind) in zip(_transposed(rows, len(columns)), columns, strict=True)
    ]
    dtype = np.dtype(
        [
            (title, _column_dtype(kind, column))
            for column, (title, kind) in zip(cells, columns, strict=True)
        ]
    )
    table = np.empty(len(rows), dtype=dtype)
    for column, (title, _) in zip(cells, columns, strict=True):
        table[title] = column
    group.create_dataset(name, data=table, track_times=False)


def column_titles(group: h5py.Group, name: str) -> frozenset[str]:
    """Which columns a table has.

    Raises:
        RecordFormatError: it is missing, or damaged.
    """
    dataset = dataset_of(group, name)
    with reading(dataset.name):
        return frozenset(dataset.dtype.names or ())


def read_table(group: h5py.Group, name: str, columns: Columns) -> list[tuple[Cell, ...]]:
    """Read what `write_table` wrote, row by row; columns it does not know are passed over.

    Raises:
        RecordFormatError: the table is missing, damaged, or lacks a column.
    """
    dataset = dataset_of(group, name)
    place = f"{group.name}/{name}"
    table = read_whole(dataset)
    titles = table.dtype.names if isinstance(table, np.ndarray) else None
    if not isinstance(table, np.ndarray) or titles is None or table.ndim != 1:
        raise RecordFormatError(f"{place} must be a table with one row per entry")
    read: list[list[Cell]] = []
    for title, kind in columns:
        if title not in titles:
            raise RecordFormatError(f"{place} lacks the column {title}")
        read.append(_column(table[title], kind, f"{place}:{title}"))
    return list(zip(*read, strict=True))


def dataset_of(group: h5py.Group, name: str) -> h5py.Dataset:
    """Open a dataset.

    Raises:
        RecordFormatError: there is none of that name.
    """
    with reading(f"{group.name}/{name}"):
        found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        raise RecordFormatError(f"{group.name} lacks the dataset {name}")
    return found


def read_whole(dataset: h5py.Dataset) -> object:
    """Read a text, a table or a figure at once.

    Raises:
        RecordFormatError: it is damaged, or unpacks to much more than the file holds for it.
    """
    with reading(dataset.name):
        if dataset.nbytes > max(_PACKED_BYTES_MOST, dataset.id.get_storage_size()):
            raise RecordFormatError(
                f"{dataset.name} unpacks to {dataset.nbytes} bytes: texts, tables and figures of "
                f"more than {_PACKED_BYTES_MOST} bytes must not be packed"
            )
        value: object = dataset[()]
    return value


def decoded(data: bytes, place: str) -> str:
    """Decode UTF-8.

    Raises:
        RecordFormatError: the bytes are something else.
    """
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise RecordFormatError(f"{place} must be UTF-8 text: {error}") from error


def _fixed_text(text: str) -> NDArray[np.bytes_]:
    data = storable_text(text).encode("utf-8")
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))


def _attribute(group: h5py.Group, name: str) -> object:
    with reading(f"{group.name}@{name}"):
        value: object = group.attrs.get(name)
    if value is None:
        raise RecordFormatError(f"{group.name} lacks the attribute {name}")
    return value


def _wrong_attribute(
    group: h5py.Group, name: str, expected: str, value: object
) -> RecordFormatError:
    kind = "NaN" if isinstance(value, float) and math.isnan(value) else type(value).__name__
    return RecordFormatError(f"{group.name}@{name} must be {expected}, got {kind}")


def _column(values: NDArray[np.generic], kind: Kind, place: str) -> list[Cell]:
    wanted = {str: "S", int: "iu", float: "f"}[kind]
    if values.dtype.kind not in wanted:
        raise RecordFormatError(f"{place} must hold {kind.__name__} values, got {values.dtype}")
    if kind is str:
        return [decoded(bytes(value), place) for value in values]
    return [kind(value) for value in values]


def _column_dtype(kind: Kind, cells: Sequence[object]) -> np.dtype[np.generic]:
    if kind is str:
        longest = max((len(cell) for cell in cells if isinstance(cell, bytes)), default=0)
        dtype: np.dtype[np.generic] = h5py.string_dtype("utf-8", max(1, longest))
        return dtype
    return np.dtype("<i8") if kind is int else np.dtype("<f8")


def _transposed(rows: Sequence[Sequence[Cell]], n_columns: int) -> list[list[Cell]]:
    return [[row[column] for row in rows] for column in range(n_columns)]
