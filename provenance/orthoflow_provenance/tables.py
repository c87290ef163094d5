"""Flat tables: one compound value per row, as any HDF5 program shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.encoding import dataset_of, decoded, reading, storable_text
from orthoflow_provenance.errors import RecordFormatError

Cell: TypeAlias = str | int | float
Kind: TypeAlias = type[str] | type[int] | type[float]
Columns: TypeAlias = Sequence[tuple[str, Kind]]


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


def read_table(group: h5py.Group, name: str, columns: Columns) -> list[tuple[Cell, ...]]:
    """Read what `write_table` wrote, row by row; columns it does not know are passed over.

    Raises:
        RecordFormatError: the table is missing, damaged, or lacks a column.
    """
    dataset = dataset_of(group, name)
    place = f"{group.name}/{name}"
    with reading(place):
        table: object = dataset[()]
    titles = table.dtype.names if isinstance(table, np.ndarray) else None
    if not isinstance(table, np.ndarray) or titles is None or table.ndim != 1:
        raise RecordFormatError(f"{place} must be a table with one row per entry")
    read: list[list[Cell]] = []
    for title, kind in columns:
        if title not in titles:
            raise RecordFormatError(f"{place} lacks the column {title}")
        read.append(_column(table[title], kind, f"{place}:{title}"))
    return list(zip(*read, strict=True))


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
