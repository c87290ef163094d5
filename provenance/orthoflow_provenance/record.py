"""The record of a run as an HDF5 file: the document, the contents it references, and the seal.

`/document` contains the record as JSON. It references products and the bytes of files by their
digests. Other objects repeat parts of the document for users of HDFView and h5py: a group for each
cell, and a table of metrics. `/seal` is the digest of the whole file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.arrays import (
    PRODUCT_GROUP,
    StoredPayload,
    payload_digest,
    read_payload,
)
from orthoflow_provenance.document import (
    DIGEST_PREFIX,
    FORMAT_VERSION,
    PRODUCT_FORMAT,
    RUN_FORMAT,
    InputFileError,
    RecordedCell,
    RecordedFile,
    RecordedInput,
    RecordFormatError,
    RunRecord,
    cost_metrics,
    from_json,
    sha256_text,
    to_json,
)
from orthoflow_provenance.hdf5 import (
    attribute_value,
    create_file,
    create_group,
    dataset_of,
    fixed_text,
    open_group,
    read_text,
    read_whole,
    reading,
    safe_open,
    text_attribute,
    write_array,
)
from orthoflow_provenance.paths import check_name, create_below, path_below, without_folders

ProductFile: TypeAlias = Callable[[str], Path | None]
InputFile: TypeAlias = Callable[[str], Path | None]

DOCUMENT: Final = "document"
SEAL: Final = "seal"
CONTENT_SHA256: Final = "content_sha256"
PRODUCTS: Final = "products"
FILES: Final = "files"
CELLS: Final = "cells"
_UNSEALED: Final = "0" * 64
_BLOCK_BYTES: Final = 16 << 20
# Attributes are meant for quick inspection, so longer values are truncated; the document contains
# them in full.
_LONGEST_ATTRIBUTE: Final = 1000
_PLAIN: Final = (str, int, float, bool)


@dataclass(frozen=True, kw_only=True)
class Node:
    """Expected content of an object in a record.

    Attributes:
        attributes: values of all attributes by name.
        data: content of a dataset; None for a group.
    """

    attributes: Mapping[str, NDArray[np.generic]]
    data: NDArray[np.generic] | None = None


@dataclass(frozen=True, kw_only=True)
class OpenRecord:
    """A record that is open for reading.

    Attributes:
        record: content of the record, except the arrays.
        content_sha256: SHA-256 of the document as stored, as 64 hexadecimal digits.
        file: the HDF5 file.
    """

    record: RunRecord
    content_sha256: str
    file: h5py.File

    def payload(self, address: str, port: str) -> StoredPayload:
        """Read an output of a cell; its memory-mapped arrays remain valid after closing the record.

        Raises:
            RecordFormatError: the output does not exist, is not embedded, is damaged, or does not
                match its digest.
        """
        cells = {cell.address: cell for cell in self.record.cells}
        try:
            output = cells[address].outputs[port]
        except KeyError as error:
            raise RecordFormatError(f"the record has no output {address}.{port}") from error
        group = open_group(self.file, product_path(output.digest))
        payload = read_payload(group)
        # Check the digest here, because the caller may not have checked the seal of the file.
        if (found := payload_digest(payload)) != output.digest:
            raise RecordFormatError(
                f"{group.name} has the digest {found}, but the record states {output.digest}: the "
                "record was changed, or the file is damaged"
            )
        return payload


def write_record(
    path: Path,
    record: RunRecord,
    product_file: ProductFile,
    *,
    embed: bool = False,
    input_file: InputFile | None = None,
    earlier: Path | None = None,
) -> str:
    """Write a record under a temporary name, and rename it when it is complete.

    Args:
        path: path of the record, usually `run.h5`; the folder must exist.
        record: content of the record, except the arrays.
        product_file: function that returns the file of a product, written by `write_product_file`,
            from the digest; None if there is no such file.
        embed: whether to embed the arrays of all outputs instead of only those marked `embedded`.
        input_file: function that returns the file with a given SHA-256; used for inputs marked
            `embedded`.
        earlier: another record of this run; the outputs embedded in it are copied.

    Returns:
        The SHA-256 of the document, as 64 hexadecimal digits.

    Raises:
        RecordFormatError: a name is not allowed in a record, or a product to embed is missing, is
            damaged or does not match its digest.
        InputFileError: an input file to embed is missing or does not match its digest.
        OSError: the file cannot be written, for example because the disk is full. An existing file
            at `path` is not changed.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    written = _as_written(record, embed=embed)
    _check_names(written)
    text = document_text(written)
    with ExitStack() as stack:
        before = stack.enter_context(safe_open(earlier, RUN_FORMAT)) if earlier else None
        file = stack.enter_context(create_file(part))
        for name, node in expected_nodes(written, text).items():
            write_node(file, name, node)
        products = create_group(file, PRODUCTS)
        for digest in _embedded(written):
            _embed_product(products, digest, product_file, before)
        files = create_group(file, FILES)
        for cell in written.cells:
            for figure in cell.figures:
                if (sha256 := hashlib.sha256(figure.data).hexdigest()) not in files:
                    write_array(files, sha256, np.frombuffer(figure.data, dtype=np.uint8))
        for entry in written.inputs:
            for given in entry.files if entry.embedded else ():
                if given.sha256 not in files:
                    _embed_file(files, entry.name, given, input_file and input_file(given.sha256))
        offset = write_array(file, SEAL, fixed_text(_UNSEALED)).id.get_offset()
    seal_file(part, offset)
    part.replace(path)
    _sync_folder(path.parent)
    return sha256_text(text)


def read_record(path: Path) -> RunRecord:
    """Read the content of a record, except the arrays.

    Raises:
        RecordFormatError: the file is not a record of this format version, or is damaged or
            incomplete.
        OSError: the file cannot be opened.
    """
    with open_record(path) as opened:
        return opened.record


@contextmanager
def open_record(path: Path) -> Iterator[OpenRecord]:
    """Open a record for reading.

    Raises:
        RecordFormatError: the file is not a record of this format version, or is damaged or
            incomplete.
        OSError: the file cannot be opened.
    """
    with safe_open(path, RUN_FORMAT) as file:
        yield OpenRecord(
            record=record_of(file), content_sha256=text_attribute(file, CONTENT_SHA256), file=file
        )


def record_of(file: h5py.File) -> RunRecord:
    """Read the record from the document of a file whose format has been checked.

    Raises:
        RecordFormatError: a required part is missing or damaged.
    """

    def contents(sha256: str) -> bytes:
        check_name(sha256, "the file")
        return np.asarray(read_whole(dataset_of(open_group(file, FILES), sha256))).tobytes()

    return from_json(read_text(file, DOCUMENT), contents)


def document_text(record: RunRecord) -> str:
    """Return the document of a record as JSON text."""
    return json.dumps(to_json(record), ensure_ascii=False, allow_nan=False, indent=1)


def expected_nodes(record: RunRecord, text: str) -> dict[str, Node]:
    """Return the objects that repeat parts of the document, by path.

    Parents precede their children. Products, files and the seal are not included.

    Args:
        record: the record.
        text: the document of the record.
    """
    root = {"format": RUN_FORMAT, "format_version": FORMAT_VERSION, **plain_fields(record)}
    nodes = {
        "/": _node({**root, CONTENT_SHA256: sha256_text(text)}),
        f"/{DOCUMENT}": _node(data=fixed_text(text)),
        "/workflow": _node(data=fixed_text(record.workflow_source)),
        "/metrics": _node(data=_metrics_table(record)),
        f"/{CELLS}": _node(),
    }
    for cell in record.cells:
        place = f"/{CELLS}/{cell.address}"
        nodes[place] = _node(plain_fields(cell))
        nodes[f"{place}/params"] = _node(data=_parameter_table(cell))
        nodes[f"{place}/outputs"] = _node(data=_output_table(cell))
        nodes[f"{place}/log"] = _node(data=fixed_text(cell.log))
    return nodes


def product_path(digest: str) -> str:
    """Return the path of a product in a record, given its digest.

    Raises:
        RecordFormatError: the string is not a digest.
    """
    scheme, _, digits = digest.partition(":")
    if f"{scheme}:" != DIGEST_PREFIX or not is_sha256(digits):
        raise RecordFormatError(f"{digest!r} is not a SHA-256 digest")
    return f"/{PRODUCTS}/{digits}"


def is_sha256(text: str) -> bool:
    """Return whether a string consists of 64 lower-case hexadecimal digits."""
    return len(text) == 64 and not set(text) - set("0123456789abcdef")


def file_sha256(path: Path, offset: int) -> str:
    """Return the SHA-256 of a record file in which the digits of the seal are replaced by zeros.

    Args:
        path: the file.
        offset: position of the 64 bytes of the seal in the file.
    """
    digest, position = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while block := bytearray(stream.read(_BLOCK_BYTES)):
            start = min(max(offset - position, 0), len(block))
            stop = min(max(offset + len(_UNSEALED) - position, 0), len(block))
            block[start:stop] = b"0" * (stop - start)
            digest.update(block)
            position += len(block)
    return digest.hexdigest()


def extract_files(
    path: Path, inputs: tuple[RecordedInput, ...], folder: Path
) -> Mapping[str, tuple[Path, ...]]:
    """Write the embedded input files of a record to a folder, with their original names.

    Args:
        path: the record.
        inputs: inputs of the record.
        folder: the folder; created if missing. Each file is written to a separate subfolder,
            because several files may have the same name.

    Returns:
        The files of each input, by the name of the input, in the order of the record. Inputs that
        are not embedded are omitted.

    Raises:
        RecordFormatError: a file is damaged, does not match the record, or has an invalid name.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with safe_open(path, RUN_FORMAT) as opened:
        return {
            entry.name: tuple(_extracted(opened, entry, folder))
            for entry in inputs
            if entry.embedded
        }


def _as_written(record: RunRecord, *, embed: bool) -> RunRecord:
    def clean(text: str) -> str:
        # HDF5 strings cannot contain NUL, and UTF-8 cannot contain unpaired surrogates.
        return without_folders(text.replace("\0", "").encode("utf-8", "replace").decode("utf-8"))

    cells = tuple(
        dataclasses.replace(
            cell,
            error_message=clean(cell.error_message),
            warnings=tuple(map(clean, cell.warnings)),
            diagnostics=tuple(
                dataclasses.replace(one, text=clean(one.text), remedy=clean(one.remedy))
                for one in cell.diagnostics
            ),
            log=clean(cell.log),
            outputs={
                port: dataclasses.replace(output, embedded=output.embedded or embed)
                for port, output in cell.outputs.items()
            },
        )
        for cell in record.cells
    )
    return dataclasses.replace(
        record,
        workflow_resolved=clean(record.workflow_resolved),
        overrides=tuple(map(clean, record.overrides)),
        cells=cells,
    )


def _check_names(record: RunRecord) -> None:
    """Check that names can be names of HDF5 links, and that addresses are unique."""
    addresses: set[str] = set()
    for cell in record.cells:
        if cell.address in addresses:
            raise RecordFormatError(f"the cell {cell.address!r} occurs twice")
        addresses.add(check_name(cell.address, "the cell"))
        for port in (*cell.inputs, *cell.outputs):
            check_name(port, "the port")
    for entry in record.inputs:
        for file in entry.files:
            check_name(file.name, f"the file of the input {entry.name}")


def _embedded(record: RunRecord) -> Iterable[str]:
    return dict.fromkeys(
        output.digest
        for cell in record.cells
        for output in cell.outputs.values()
        if output.embedded
    )


def _node(
    attributes: Mapping[str, str | float] | None = None, data: NDArray[np.generic] | None = None
) -> Node:
    return Node(
        attributes={name: attribute_value(value) for name, value in (attributes or {}).items()},
        data=data,
    )


def plain_fields(entry: object) -> dict[str, str | float]:
    """Return the fields of a dataclass that are numbers or strings; long strings are truncated."""
    found: dict[str, str | float] = {}
    for item in dataclasses.fields(entry):  # type: ignore[arg-type] # any dataclass
        value = getattr(entry, item.name)
        if item.name == "seed":
            # A seed may be too large for the integer types of HDF5, so it is stored as a string.
            value = "" if value is None else str(value)
        if isinstance(value, _PLAIN) and not item.name.startswith(("workflow_", "key_", "log")):
            found[item.name] = value[:_LONGEST_ATTRIBUTE] if isinstance(value, str) else value
    return found


def _parameter_table(cell: RecordedCell) -> NDArray[np.generic]:
    rows = [
        (name, json.dumps(value, ensure_ascii=False), name in cell.params_set)
        for name, value in cell.params.items()
    ]
    return _table({"name": "", "value": "", "is_set": "<i8"}, rows)


def _output_table(cell: RecordedCell) -> NDArray[np.generic]:
    rows = [(port, one.type_name, one.digest) for port, one in cell.outputs.items()]
    return _table({"port": "", "type_name": "", "digest": ""}, rows)


def _metrics_table(record: RunRecord) -> NDArray[np.generic]:
    columns = {"name": "", "value": "<f8", "unit": "", "label": "", "better": ""}
    rows = [
        (cell.address, cell.step, cell.method, *(getattr(metric, name) for name in columns))
        for cell in record.cells
        if cell.status == "ok"
        for metric in (*cell.metrics, *cost_metrics(cell))
    ]
    return _table({"cell": "", "step": "", "method": "", **columns}, rows)


def _table(columns: Mapping[str, str], rows: Sequence[Sequence[Any]]) -> NDArray[np.generic]:
    """Return rows as a structured array.

    Args:
        columns: NumPy types by name; an empty type means strings of the required length.
        rows: a value for each column.
    """
    kinds: list[tuple[str, Any]] = []
    values: list[list[Any]] = []
    for index, (name, kind) in enumerate(columns.items()):
        column = [row[index] if kind else fixed_text(row[index]).item() for row in rows]
        width = 1 if kind else max((len(text) for text in column), default=1)
        kinds.append((name, kind or h5py.string_dtype("utf-8", max(1, width))))
        values.append(column)
    table = np.empty(len(rows), dtype=kinds)
    for name, column in zip(columns, values, strict=True):
        table[name] = column
    return table


def write_node(file: h5py.File, path: str, node: Node) -> None:
    """Write one group, array or set of attributes of a record."""
    parent, _, name = path.rpartition("/")
    if path == "/":
        item = file
    elif node.data is None:
        item = create_group(file[parent or "/"], name)
    else:
        item = write_array(file[parent or "/"], name, node.data)
    for title, value in node.attributes.items():
        item.attrs[title] = value


def _embed_product(
    products: h5py.Group, digest: str, product_file: ProductFile, earlier: h5py.File | None
) -> None:
    place = product_path(digest)
    if earlier is not None and place in earlier:
        _copy_product(products, digest, open_group(earlier, place))
        return
    path = product_file(digest)
    if path is None:
        raise RecordFormatError(
            f"the product {digest} is no longer in the store: run the workflow again"
        )
    with safe_open(path, PRODUCT_FORMAT) as source:
        _copy_product(products, digest, open_group(source, PRODUCT_GROUP))


def _copy_product(products: h5py.Group, digest: str, source: h5py.Group) -> None:
    stored = text_attribute(source, "digest")
    if stored != digest:
        name = Path(source.file.filename).name
        raise RecordFormatError(f"{name} must contain the product {digest}, got {stored}")
    # This copies chunks unchanged; decompressing and compressing them would take ten times as long.
    source.file.copy(source, products, name=digest.removeprefix(DIGEST_PREFIX))


def _embed_file(files: h5py.Group, input_name: str, file: RecordedFile, path: Path | None) -> None:
    if path is None:
        raise InputFileError(
            f"the file {file.name} of the input {input_name} cannot be embedded, because no file "
            f"has its SHA-256 {file.sha256[:12]}..."
        )
    another = InputFileError(
        f"the input file {path.name} must have {file.size_bytes} bytes with the SHA-256 "
        f"{file.sha256[:12]}..., but has been changed since it was read"
    )
    if not path.is_file():
        # Do not open other objects: reading from a pipe would block.
        raise another
    # Use neither chunks nor compression, because photos and scans are already compressed. Checksums
    # are not needed, because the document contains the digest.
    dataset = files.create_dataset(
        file.sha256, shape=(file.size_bytes,), dtype=np.uint8, track_times=False
    )
    digest, n_bytes = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            if n_bytes + len(block) > file.size_bytes:
                raise another
            dataset[n_bytes : n_bytes + len(block)] = np.frombuffer(block, dtype=np.uint8)
            digest.update(block)
            n_bytes += len(block)
    if n_bytes != file.size_bytes or digest.hexdigest() != file.sha256:
        raise another


def seal_file(path: Path, offset: int) -> None:
    """Write the SHA-256 of the bytes before `offset` into the seal, which begins there."""
    seal = file_sha256(path, offset)
    with path.open("r+b") as stream:
        stream.seek(offset)
        stream.write(seal.encode())
        stream.flush()
        os.fsync(stream.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _extracted(opened: h5py.File, entry: RecordedInput, folder: Path) -> Iterator[Path]:
    files = open_group(opened, FILES)
    for index, file in enumerate(entry.files):
        check_name(file.sha256, "the file")
        dataset = dataset_of(files, file.sha256)
        # Check before writing, because the untrusted record determines how much disk space is used.
        if dataset.dtype != np.uint8 or dataset.shape != (file.size_bytes,):
            raise RecordFormatError(
                f"{dataset.name} must contain the {file.size_bytes} bytes of "
                f"{file.name!r}, got the type {dataset.dtype} and the shape {dataset.shape}"
            )
        inside = f"{entry.name}/{index:04}/{file.name}"
        with create_below(folder, inside) as stream:
            sha256 = dataset_sha256(dataset, stream.write)
        if sha256 != file.sha256:
            raise RecordFormatError(
                f"{dataset.name} has the SHA-256 {sha256}, but the record states {file.sha256} "
                f"for {file.name!r}"
            )
        yield path_below(folder, inside)


def dataset_sha256(dataset: h5py.Dataset, also: Callable[[bytes], object] = len) -> str:
    """Return the SHA-256 of a dataset of bytes; the dataset is read block by block.

    Args:
        dataset: one-dimensional dataset of uint8.
        also: function that is also called with each block.

    Raises:
        RecordFormatError: the dataset is damaged.
    """
    digest = hashlib.sha256()
    for start in range(0, dataset.size, _BLOCK_BYTES):
        with reading(dataset.name):
            block = dataset[start : start + _BLOCK_BYTES].tobytes()
        digest.update(block)
        also(block)
    return digest.hexdigest()
