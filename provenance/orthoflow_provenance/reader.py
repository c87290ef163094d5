"""Reading a record: the run as dataclasses, products on demand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from orthoflow_provenance import layout
from orthoflow_provenance.digests import payload_digest
from orthoflow_provenance.encoding import (
    dataset_of,
    int_attribute,
    read_text,
    read_texts,
    read_whole,
    reading,
    text_attribute,
)
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.input_files import has_contents
from orthoflow_provenance.model import (
    RUN_FORMAT,
    RUN_FORMAT_VERSION,
    Figure,
    PublishedFile,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)
from orthoflow_provenance.payloads import StoredPayload, open_group, read_payload
from orthoflow_provenance.safe import check_format, safe_open
from orthoflow_provenance.seal import SEAL_ATTRIBUTE

Entry = TypeVar("Entry")


@dataclass(frozen=True, kw_only=True)
class OpenRecord:
    """An open record.

    Attributes:
        record: everything but the arrays.
        content_sha256: the content digest that seals the record, 64 hexadecimal digits.
        file: the HDF5 file.
    """

    record: RunRecord
    content_sha256: str
    file: h5py.File

    def payload(self, address: str, port: str) -> StoredPayload:
        """Read an output of a cell; arrays of mapped products stay valid after closing.

        Raises:
            RecordFormatError: there is no such output, it is not embedded, it is damaged, or it is
                not what its digest says.
        """
        cell = next((cell for cell in self.record.cells if cell.address == address), None)
        output = None if cell is None else cell.outputs.get(port)
        if output is None:
            raise RecordFormatError(f"the record has no output {port} of the cell {address}")
        if not output.embedded:
            raise RecordFormatError(
                f"the record names the output {port} of {address} ({output.type_name}) by its "
                f"digest only, {output.digest}: it is in the store, or run again with --embed"
            )
        return _payload(self.file, address, port)


@contextmanager
def open_outputs(path: Path) -> Iterator[Callable[[str, str], StoredPayload]]:
    """Open a record for reading embedded outputs, each by its address and port.

    Opening looks at everything in the file, which takes longer than most outputs do. Arrays of
    mapped products stay valid after closing.

    Raises:
        RecordFormatError: the file is no record or damaged; of the reading, it has no such output,
            or that is not what its digest says.
        OSError: the file cannot be opened.
    """
    with safe_open(path) as file:
        check_format(file, RUN_FORMAT, RUN_FORMAT_VERSION)
        yield partial(_payload, file)


def read_record(path: Path) -> RunRecord:
    """Read all of a record but the arrays.

    Raises:
        RecordFormatError: the file is no record, damaged, incomplete, or of a newer format.
        OSError: the file cannot be opened.
    """
    with open_record(path) as opened:
        return opened.record


@contextmanager
def open_record(path: Path) -> Iterator[OpenRecord]:
    """Open a record for reading.

    Raises:
        RecordFormatError: the file is no record, damaged, incomplete, or of a newer format.
        OSError: the file cannot be opened.
    """
    with safe_open(path) as file:
        check_format(file, RUN_FORMAT, RUN_FORMAT_VERSION)
        yield OpenRecord(
            record=record_of(file), content_sha256=text_attribute(file, SEAL_ATTRIBUTE), file=file
        )


def _payload(file: h5py.File, address: str, port: str) -> StoredPayload:
    cell = open_group(open_group(file, layout.CELLS), address)
    group = open_group(open_group(cell, layout.CELL_OUTPUTS), port)
    payload = read_payload(group, map_arrays=True)
    # Who shows or hands on arrays has looked at the smaller parts of the seal at most.
    if (found := payload_digest(payload)) != payload.digest:
        raise RecordFormatError(
            f"{group.name} has the digest {found}, the record says {payload.digest}: it was "
            "changed, or the file is damaged"
        )
    return payload


def record_of(file: h5py.File) -> RunRecord:
    """Read the record of a file whose format has been checked.

    Raises:
        RecordFormatError: something required is missing or damaged.
    """
    workflow = open_group(file, layout.WORKFLOW)
    return RunRecord(
        **layout.read_fields(file, RunRecord),
        workflow_source=read_text(workflow, "source"),
        workflow_resolved=read_text(workflow, "resolved"),
        overrides=read_texts(workflow, "overrides"),
        inputs=_entries(file, layout.INPUTS, _input),
        environments=_entries(file, layout.ENVIRONMENTS, _environment),
        cells=_entries(file, layout.CELLS, _cell),
        published=_published(file),
    )


def _entries(
    file: h5py.File, name: str, read: Callable[[str, h5py.Group], Entry]
) -> tuple[Entry, ...]:
    parent = open_group(file, name)
    with reading(f"/{name}"):
        names = sorted(parent)
    groups = [(open_group(parent, child), child) for child in names]
    groups.sort(key=lambda pair: int_attribute(pair[0], "index"))
    return tuple(read(child, group) for group, child in groups)


def _input(name: str, group: h5py.Group) -> RecordedInput:
    return RecordedInput(
        name=name, embedded=has_contents(group), **layout.read_fields(group, RecordedInput)
    )


def _published(file: h5py.File) -> tuple[PublishedFile, ...]:
    with reading(f"/{layout.PUBLISHED}"):
        is_there = layout.PUBLISHED in file
    # Records of version 1.0 do not name them.
    return layout.read_rows(file, layout.PUBLISHED, PublishedFile) if is_there else ()


def _environment(name: str, group: h5py.Group) -> RecordedEnvironment:
    return RecordedEnvironment(id=name, **layout.read_fields(group, RecordedEnvironment))


def _cell(address: str, group: h5py.Group) -> RecordedCell:
    return RecordedCell(
        address=address,
        figures=_figures(group),
        inputs=_products(group, layout.CELL_INPUTS),
        outputs=_products(group, layout.CELL_OUTPUTS),
        **layout.read_fields(group, RecordedCell),
    )


def _figures(group: h5py.Group) -> tuple[RecordedFigure, ...]:
    figures = open_group(group, layout.FIGURES)
    with reading(figures.name):
        names = sorted(figures)
    return tuple(_figure(dataset_of(figures, name)) for name in names)


def _figure(dataset: h5py.Dataset) -> RecordedFigure:
    return RecordedFigure(
        data=np.asarray(read_whole(dataset)).tobytes(), **layout.read_fields(dataset, Figure)
    )


def _products(group: h5py.Group, name: str) -> dict[str, RecordedProduct]:
    parent = open_group(group, name)
    with reading(parent.name):
        ports = sorted(parent)
    return {port: _product(open_group(parent, port)) for port in ports}


def _product(group: h5py.Group) -> RecordedProduct:
    return RecordedProduct(
        type_name=text_attribute(group, "type"),
        encoding_version=int_attribute(group, "encoding_version"),
        digest=text_attribute(group, "digest"),
        source=text_attribute(group, "source"),
        embedded=bool(int_attribute(group, "embedded")),
    )
