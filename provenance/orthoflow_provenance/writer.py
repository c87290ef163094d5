"""Writing a record: the run as it happened and its products, sealed, in one file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import h5py
import numpy as np

from orthoflow_provenance import layout
from orthoflow_provenance.digests import canonical_json, sha256_text
from orthoflow_provenance.encoding import (
    check_name,
    int_attribute,
    set_attributes,
    storable_text,
    text_attribute,
    write_text,
)
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.input_files import InputFile, embed_files
from orthoflow_provenance.model import (
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)
from orthoflow_provenance.payloads import PRODUCT_GROUP, open_group
from orthoflow_provenance.privacy import without_folders
from orthoflow_provenance.safe import safe_open
from orthoflow_provenance.seal import seal_file
from orthoflow_provenance.sinks import create_file, create_group
from orthoflow_provenance.tables import write_table, write_texts

ProductFile: TypeAlias = Callable[[str], Path | None]


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


def _without_folders(record: RunRecord) -> RunRecord:
    def clean(texts: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(without_folders(text) for text in texts)

    cells = tuple(
        dataclasses.replace(
            cell,
            error_message=without_folders(cell.error_message),
            warnings=clean(cell.warnings),
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
            "format": layout.RUN_FORMAT,
            "format_version": layout.RUN_FORMAT_VERSION,
            "created_by": record.created_by,
            "run_id": record.run_id,
            "name": record.name,
            "status": record.status,
            "started": record.started,
            "ended": record.ended,
            "seed": str(record.seed),
            "workflow_sha256": sha256_text(source),
        },
    )
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
    published = [(file.path, file.size_bytes, file.sha256) for file in record.published]
    write_table(file, layout.PUBLISHED, layout.PUBLISHED_COLUMNS, published)
    environments = create_group(file, layout.ENVIRONMENTS)
    for index, environment in enumerate(record.environments):
        _write_environment(
            _create_entry(environments, environment.id, "the environment", index), environment
        )


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
    rows = [(file.name, file.size_bytes, file.sha256) for file in entry.files]
    write_table(group, "files", layout.FILE_COLUMNS, rows)


def _write_environment(group: h5py.Group, environment: RecordedEnvironment) -> None:
    set_attributes(
        group,
        {
            "python": environment.python,
            "os": environment.os,
            "cpu": environment.cpu,
            "cores": environment.cores,
            "threads": environment.threads,
            "git_commit": environment.git_commit,
        },
    )
    write_table(group, "packages", layout.PACKAGE_COLUMNS, list(environment.packages.items()))


def _write_cell(group: h5py.Group, cell: RecordedCell) -> None:
    set_attributes(
        group,
        {
            "step": cell.step,
            "method": cell.method,
            "status": cell.status,
            "repeat": cell.repeat,
            "distribution": cell.distribution,
            "distribution_version": cell.distribution_version,
            "result_version": cell.result_version,
            "determinism": cell.determinism,
            "error_type": cell.error_type,
            "key": cell.key,
            "seed": "" if cell.seed is None else str(cell.seed),
            "started": cell.started,
            "ended": cell.ended,
            "wall_s": float(cell.wall_s),
            "cpu_s": float(cell.cpu_s),
            "peak_rss_mib": float(cell.peak_rss_mib),
            "environment": cell.environment,
            "cached_from": cell.cached_from,
        },
    )
    write_text(group, "error_message", cell.error_message)
    write_text(group, "params", canonical_json(cell.params))
    write_text(group, "params_set", canonical_json(cell.params_set))
    write_text(group, "key_preimage", cell.key_preimage)
    write_text(group, "log", cell.log)
    write_texts(group, "warnings", cell.warnings)
    write_texts(group, "citations", cell.citations)
    write_table(group, "assignment", layout.ASSIGNMENT_COLUMNS, list(cell.assignment.items()))
    rows = [(metric.name, metric.value, metric.unit) for metric in cell.metrics]
    write_table(group, "metrics", layout.METRIC_COLUMNS, rows)
    figures = create_group(group, layout.FIGURES)
    for index, figure in enumerate(cell.figures):
        _write_figure(figures, figure, index)


def _write_figure(group: h5py.Group, figure: RecordedFigure, index: int) -> None:
    dataset = group.create_dataset(f"{index:04}", data=np.frombuffer(figure.data, dtype=np.uint8))
    set_attributes(
        dataset,
        {"name": figure.name, "caption": figure.caption, "media_type": figure.media_type},
    )


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
