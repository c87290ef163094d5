"""Writing a record: the run as it happened and its products, sealed, in one file."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import h5py
import numpy as np

from orthoflow_provenance import layout
from orthoflow_provenance.digests import sha256_text
from orthoflow_provenance.encoding import (
    check_name,
    int_attribute,
    set_attributes,
    storable_text,
    text_attribute,
    write_text,
    write_texts,
)
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.input_files import InputFile, embed_files
from orthoflow_provenance.model import (
    RUN_FORMAT,
    RUN_FORMAT_VERSION,
    Figure,
    PublishedFile,
    RecordedCell,
    RecordedFigure,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)
from orthoflow_provenance.payloads import PRODUCT_GROUP, open_group
from orthoflow_provenance.safe import safe_open
from orthoflow_provenance.seal import seal_file
from orthoflow_provenance.sinks import create_file, create_group

ProductFile: TypeAlias = Callable[[str], Path | None]

_LETTER: Final = r"""[^\s/'"<>|,;:()\[\]{}\\]"""
# An absolute path of at least two parts that does not continue a word, a relative path or a URL.
_PATH: Final = re.compile(
    rf"(?<![\w.:/~*?\\-]) (?:file://)? / (?:{_LETTER}+/)+ (?P<last>{_LETTER}*)", re.VERBOSE
)


def write_record(
    path: Path,
    record: RunRecord,
    product_file: ProductFile,
    *,
    embed: bool = False,
    keep_folders: bool = False,
    input_file: InputFile | None = None,
    earlier: Path | None = None,
) -> str:
    """Write a record next to its final place and move it there when it is complete.

    Args:
        path: the record, usually `run.h5`; its folder exists.
        record: everything but the arrays.
        product_file: digest -> file that `write_product_file` wrote, None when there is none.
        embed: put in the arrays of all outputs, not only of those marked `embedded`.
        keep_folders: leave absolute paths in logs, messages and options.
        input_file: SHA-256 -> file with it, for the inputs marked `embedded`.
        earlier: another record of this run; the outputs embedded in it are taken from there.

    Returns:
        The content digest, 64 hexadecimal digits.

    Raises:
        RecordFormatError: a name is impossible in a record, or a product to embed is missing,
            damaged or another one.
        OSError: the file cannot be written, e.g. because the disk is full; what stood at `path`
            before is untouched.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    written = record if keep_folders else _without_folders(record)
    with ExitStack() as stack:
        shelf = _Shelf(
            product_file=product_file,
            earlier=stack.enter_context(safe_open(earlier)) if earlier else None,
        )
        file = stack.enter_context(create_file(part))
        _write_run(file, written, input_file or _no_file)
        cells = create_group(file, layout.CELLS)
        for index, cell in enumerate(written.cells):
            group = _create_entry(cells, cell.address, "the cell", index)
            _write_cell(group, cell)
            _write_products(group, cell, shelf, embed=embed)
        content_sha256 = seal_file(file)
    part.replace(path)
    _sync_folder(path.parent)
    return content_sha256


def without_folders(text: str, folders: Sequence[Path] = ()) -> str:
    """Reduce absolute paths in a text to their last part.

    Args:
        text: a log, a message, an option as it was typed.
        folders: folders to take out literally first, for names with spaces, which no pattern
            finds the end of; the home and the working directory are always among them.

    >>> without_folders("cannot read /home/jane/scans/hall.e57: 1/2 of it is missing")
    'cannot read hall.e57: 1/2 of it is missing'
    """
    for folder in sorted({*map(str, folders), *_own_folders()}, key=len, reverse=True):
        if len(folder) > 1:
            text = text.replace(f"{folder}/", "")
    return _PATH.sub(lambda match: match["last"], text)


def _own_folders() -> set[str]:
    folders = {str(Path.cwd())}
    # Where no home directory is known no text can name it.
    with suppress(RuntimeError):
        folders.add(str(Path.home()))
    return folders


def _without_folders(record: RunRecord) -> RunRecord:
    def clean(texts: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(without_folders(text) for text in texts)

    cells = tuple(
        dataclasses.replace(
            cell,
            error_message=without_folders(cell.error_message),
            warnings=clean(cell.warnings),
            diagnostics=tuple(
                dataclasses.replace(one, text=without_folders(one.text)) for one in cell.diagnostics
            ),
            log=without_folders(cell.log),
        )
        for cell in record.cells
    )
    return dataclasses.replace(
        record,
        workflow_resolved=without_folders(record.workflow_resolved),
        overrides=clean(record.overrides),
        cells=cells,
    )


def _no_file(_sha256: str) -> None:
    """Know no input file."""


def _write_run(file: h5py.File, record: RunRecord, input_file: InputFile) -> None:
    source = storable_text(record.workflow_source)
    set_attributes(
        file,
        {
            "format": RUN_FORMAT,
            "format_version": RUN_FORMAT_VERSION,
            "workflow_sha256": sha256_text(source),
        },
    )
    layout.write_fields(file, record)
    workflow = create_group(file, layout.WORKFLOW)
    write_text(workflow, "source", source)
    write_text(workflow, "resolved", record.workflow_resolved)
    write_texts(workflow, "overrides", record.overrides)
    inputs = create_group(file, layout.INPUTS)
    for index, entry in enumerate(record.inputs):
        group = _create_entry(inputs, entry.name, "the input", index)
        _write_input(group, entry)
        if entry.embedded:
            embed_files(group, entry, input_file)
    layout.write_rows(file, layout.PUBLISHED, record.published, PublishedFile)
    environments = create_group(file, layout.ENVIRONMENTS)
    for index, environment in enumerate(record.environments):
        group = _create_entry(environments, environment.id, "the environment", index)
        layout.write_fields(group, environment)


def _create_entry(parent: h5py.Group, name: str, what: str, index: int) -> h5py.Group:
    check_name(name, what)
    if name in parent:
        raise RecordFormatError(f"{what} {name!r} is given twice")
    group = create_group(parent, name)
    set_attributes(group, {"index": index})
    return group


def _write_input(group: h5py.Group, entry: RecordedInput) -> None:
    for file in entry.files:
        if "/" in file.name:
            raise RecordFormatError(
                f"the file {file.name!r} of the input {entry.name} must be named without its folder"
            )
    layout.write_fields(group, entry)


def _write_cell(group: h5py.Group, cell: RecordedCell) -> None:
    layout.write_fields(group, cell)
    figures = create_group(group, layout.FIGURES)
    for index, figure in enumerate(cell.figures):
        _write_figure(figures, figure, index)


def _write_figure(group: h5py.Group, figure: RecordedFigure, index: int) -> None:
    dataset = group.create_dataset(f"{index:04}", data=np.frombuffer(figure.data, dtype=np.uint8))
    layout.write_fields(dataset, figure, Figure)


@dataclass(frozen=True, kw_only=True)
class _Shelf:
    """Where the products to embed are: in another record of the run, else each in a file."""

    product_file: ProductFile
    earlier: h5py.File | None

    @contextmanager
    def open(self, place: str, product: RecordedProduct) -> Iterator[h5py.Group]:
        """Open the group of a product; `place` is where it is in a record of this run."""
        if self.earlier is not None:
            group = open_group(self.earlier, place)
            if int_attribute(group, "embedded"):
                yield group
                return
        path = self.product_file(product.digest)
        if path is None:
            raise RecordFormatError(
                f"the product {product.digest} ({product.type_name}) for {place} is not in the "
                "store any more: run the workflow again"
            )
        with safe_open(path) as source:
            yield open_group(source, PRODUCT_GROUP)


def _write_products(group: h5py.Group, cell: RecordedCell, shelf: _Shelf, *, embed: bool) -> None:
    _write_references(create_group(group, layout.CELL_INPUTS), cell.inputs)
    outputs = create_group(group, layout.CELL_OUTPUTS)
    _write_references(
        outputs, {port: out for port, out in cell.outputs.items() if not (out.embedded or embed)}
    )
    for port, output in cell.outputs.items():
        if output.embedded or embed:
            check_name(port, "the port")
            _embed(outputs, port, output, shelf)


def _write_references(group: h5py.Group, products: Mapping[str, RecordedProduct]) -> None:
    for port, product in products.items():
        check_name(port, "the port")
        set_attributes(
            create_group(group, port),
            {
                "type": product.type_name,
                "encoding_version": product.encoding_version,
                "digest": product.digest,
                "source": product.source,
                "embedded": 0,
            },
        )


def _embed(group: h5py.Group, port: str, product: RecordedProduct, shelf: _Shelf) -> None:
    with shelf.open(f"{group.name}/{port}", product) as source:
        stored = text_attribute(source, "digest")
        if stored != product.digest:
            name = Path(source.file.filename).name
            raise RecordFormatError(f"{name} must hold the product {product.digest}, got {stored}")
        # Copies chunks as they are; unpacking and packing again would be ten times slower.
        source.file.copy(source, group, name=port)
    set_attributes(group[port], {"source": product.source, "embedded": 1})


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
